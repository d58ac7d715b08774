"""Sections of docs/results.md about recording, algorithms and speed, as in `policies`."""

from experiments.page.cells import Load
from lerobot_wmrl.common.files import markdown_table as table


def planners(load: Load) -> str:
    both = {"cartesian": load("planners")["success"], "mplib": load("planners_mplib")["success"]}
    kinds = list(both["cartesian"]["push"])
    rows = [
        [planner, task.replace("_", " "), *(f"{row[kind]['k']} of {row[kind]['n']}" for kind in kinds)]
        for planner, tasks in both.items()
        for task, row in tasks.items()
    ]
    return f"""With both planners every optimal episode of every task succeeds. Near misses fail on purpose.

{table(["planner", "task", *(kind.replace("_", " ") for kind in kinds)], rows)}

Random scenes, known and unseen. A plan takes 0.05–0.2 ms of CPU with `cartesian`, 11–40 ms with `mplib`."""


def cameras(load: Load) -> str:
    rows = []
    for name, row in load("cameras")["probes"].items():
        views, size, _ = name.split(", ")
        mean = row["mean_mm"]
        errors = (" ".join(f"{mean[f'{thing}_{axis}']:.1f}" for axis in "xyz") for thing in ("object", "tcp"))
        for old, new in (("front_steep", "third_view"), ("side_mid", "side_view"), ("+", " + ")):
            views = views.replace(old, new)
        opening, contact = row["opening_percent"], 100 * row["contact_accuracy"]
        rows.append([views, size, *errors, f"{opening:.1f}", f"{contact:.1f}"])
    head = ["cameras", "size", "object x y z (mm)", "TCP x y z (mm)", "opening (%)", "touching, right (%)"]
    return f"""Positions to 2–6 mm. Contact less reliably, because a gap of 2 mm is half a pixel. Three views
of 128 pixels read best, so the recipes `cpu`, `gpu` and `paper` record these.

{table(head, rows)}

Mean errors of a small network on held-out episodes; 27,654 frames, a quarter of them for the test."""


def control(load: Load) -> str:
    rows = [
        [
            name,
            row["solved"],
            ", ".join(f"{seed['score']:.0f}" for seed in row["seeds"]),
            f"{row['seeds'][0]['steps']:,}",
        ]
        for name, row in load("control").items()
        if name != "provenance"
    ]
    return f"""They do. On Pendulum, whose returns are large, normalised values help.

{table(["training", "solved from", "score of three seeds", "steps"], rows)}

Each score is over 100 episodes, without exploration."""


def speed(load: Load) -> str:
    measured = ("imagined", "imagined_and_decoded", "imagined_without_memory")
    rows = [
        [
            row["batch"],
            *(f"{row['frames_per_s'][name]:,.0f}" for name in measured),
            f"{100 * row['share_of_floor']['imagined_and_decoded']:.0f} %",
        ]
        for row in load("world_model_speed")["by_batch"]
    ]
    found = load("world_model_speed")
    faster = found["times_faster_than_maniskill"]
    head = [
        "parallel episodes",
        "frames/s without decoding",
        "frames/s with decoding",
        "frames/s without decoding or cache",
        "with decoding, share of the roofline",
    ]
    recording, rate, ppo = load("recording_speed"), load("recording_rate"), load("ppo_speed")
    environment, start = load("environment_speed")["by_number"][-1], load("simulator_start")
    return f"""On two CPU cores 64 imaginations are {faster["stock meshes"]["64"]:.0f} times as fast as one
process of ManiSkill with its own robot meshes, {faster["light meshes"]["64"]:.0f} times as fast as with our
light ones.

{table(head, rows)}

An earlier version of the preset `cpu` (anchored, two views of 64 pixels), bfloat16, one run. *Roofline*: what
the machine's measured FLOP/s and memory bandwidth allow. Training sees
{found["by_batch"][2]["frames_per_s"]["trained"]:,.0f} frames a second. An iteration of PPO with a small
policy makes {ppo["world_model"]["steps_per_s"]:.0f} steps a second in the world model,
{ppo["maniskill"]["steps_per_s"]:.0f} in two processes of ManiSkill;
{100 * ppo["world_model"]["shares"]["update"]:.0f} % of it are the update. At {environment["environments"]}
environments rewards add {100 * min(environment["costs_more"].values()):.0f} to
{100 * max(environment["costs_more"].values()):.0f} % to imagination. Recording a step takes
{1000 * recording["cpu_s_per_step"]["light meshes"]:.0f} ms of CPU, ManiSkill's own table
{1000 * recording["cpu_s_per_step"]["ManiSkill's own"]:.0f} ms; two processes record
{rate["episodes_per_minute"]["two processes"]:.0f} episodes a minute. Without a GPU a process
has its first picture after {start["cpu_s"]["ours"]:.1f} s of CPU beyond its imports. With SAPIEN's own
shaders, which need a table that the pictures do not show, it is
{start["cpu_s"]["ours, SAPIEN's shaders"]:.1f} s, in ManiSkill's own table
{start["cpu_s"]["ManiSkill's own"]:.1f} s.

{planning_and_play(load)}"""


def planning_and_play(load: Load) -> str:
    """Return how fast the planner and the page of `lerobot-wmrl-play` are."""
    planning, page = load("planning_speed")["by_searches"][-1], load("play_speed")
    return f"""Planning for {planning["searches"]} imaginations at once, on one core and in the preset `demo`,
predicts {planning["frames_per_s"]["open_loop"]:,.0f} frames a second,
{planning["times_faster_than_frame_by_frame"]:.0f} times as many as frame by frame and
{100 * planning["share_of_floor"]:.0f} % of what the core's matrix products allow. From what a policy would do
it plans {planning["episodes_per_s"]:.1f} episodes a second, without the policy itself and the episodes' own
frames.

The page of `lerobot-wmrl-play` shows up to {page["page"]["frames_per_s"]:.0f} frames a second with
{page["cameras"]} cameras of {page["image_size"]} pixels: {page["page"]["p50_ms"]:.0f} ms from a key to the
decoded picture (99 %: {page["page"]["p99_ms"]:.0f} ms), without the browser itself. The imagined step alone
takes {page["environment"]["p50_ms"]:.0f} ms, one of ManiSkill {page["maniskill"]["p50_ms"]:.0f} ms. The page
that needs no server shows up to {page["exported"]["frames_per_s"]:.0f} frames a second in Chromium without a
window ({page["exported"]["p50_ms"]:.0f} ms; 99 %: {page["exported"]["p99_ms"]:.0f} ms)."""


def speed_gpu(load: Load) -> str:
    """Return the section: a world model's speed and OpenVLA's memory on one GPU."""
    model, memory = load("world_model_speed_gpu"), load("openvla_memory")
    network, measured = model["network"], memory["measured"]
    names = ("imagined", "imagined_and_decoded", "trained")
    rows = [
        [
            row["batch"],
            *(
                f"{row['frames_per_s'][name]:,.0f} ({100 * row['share_of_floor'][name]:.0f} %)"
                for name in names
            ),
            f"{row['times_faster_than_without_memory']:.1f}",
        ]
        for row in model["by_batch"]
    ]
    updates = [
        [
            computed["batch"],
            "on" if checkpointing else "off",
            computed["SFT, checkpointing" if checkpointing else "SFT"],
            found["GB"],
            found["a second"],
        ]
        for checkpointing in (False, True)
        for computed, found in zip(
            memory["updates"], measured["checkpointing" if checkpointing else "plain"], strict=True
        )
    ]
    decoding = measured["decoding"]
    return f"""The preset `gpu`'s action world model: {network["type"]}, {network["layers"]} layers of width
{network["width"]}, {model["image_size"]} pixels, bfloat16, random weights. Frames a second on an
{model["machine"]} and, in parentheses, their share of what its measured matrix products and memory allow:

{table(["parallel episodes", "imagined", "with decoding", "trained", "times as fast as without cache"], rows)}

Three recordings of Meta-World rendered on it meanwhile. Most of the GPU is idle, even though a step of
imagination is one CUDA graph; it has not been profiled why.
[`improve`](pilots.md#meta-world) was not fast there either.

LoRA (rank {memory["rank"]}) on OpenVLA's 7B, random weights. Gigabytes that `benchmarks/openvla_memory.py`
computes without a GPU, and the peak there:

{table(["batch", "checkpointing", "computed", "measured", "observations a second"], updates)}

One step of a rollout decodes the actions of {decoding["environments"]} environments,
{decoding["a second"]:.0f} a second, in {decoding["GB"]:.1f} GB at most."""


def training_memory(load: Load) -> str:
    """Return the section: memory that the presets' world models take in training."""
    found = load("training_memory")
    models = {
        "frame_tokenizer": "frame tokenizer",
        "action_world_model": "action world model",
        "text_world_model": "text world model",
    }
    rows = [
        [
            row["preset"],
            models[row["model"]],
            f"{row['trained parameters'] / 1e6:.1f}",
            row["batch_size"],
            f"{row['fixed']:.2f}",
            f"{1000 * row['activations of a sample']:,.0f}",
            f"{row['in training']:.1f}",
            f"{row['losses'][0]:.1f} → {row['losses'][-1]:.1f}",
        ]
        for row in found["models"]
    ]
    head = [
        "preset",
        "model",
        "trained parameters (millions)",
        "batch",
        "weights, gradients, moments (GB)",
        "activations of a sample (MB)",
        "in training (GB)",
        "loss, four steps",
    ]
    return f"""Each preset's models with its sizes and cameras, random weights and random frames. What
autograd keeps of a batch for the backward pass was counted at two small batches; it is linear in the batch.
A sample is a frame, or a clip of the preset's length. Not counted: the workspace of kernels, and what an
allocator loses. Every model then took four optimizer steps on the smaller batch.

{table(head, rows)}

The published sizes (`paper`) need a GPU of more than 80 GB for a batch of 16 clips; in several processes
([many GPUs](many_gpus.md)) each holds a share of the batch."""
