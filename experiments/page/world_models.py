"""Sections of docs/results.md about world models, as in `policies`."""

from collections.abc import Iterable, Mapping
from typing import Any, Final

from experiments.page.cells import DOMAINS, Load, counted, estimate, share
from experiments.page.value_cells import published
from experiments.study import ROOT, read_cells
from lerobot_wmrl.common.files import markdown_table as table
from lerobot_wmrl.common.statistics import Proportion

TOLD: Final = ("false_positive_rate", "recall", "under_another_instruction")
"""What is counted of a success classifier."""


def policies(load: Load) -> str:
    found = load("policies")
    rows = [
        [f"`{name.removesuffix('/pretrained_model')}`", share(row["imagined"]), share(row["maniskill"])]
        for name, row in found["policies"].items()
    ]
    gap = sum(abs(row["imagined"]["share"] - row["maniskill"]["share"]) for row in found["policies"].values())
    low, high = found["pearson"]["fisher_95"]
    return f"""Nearly, on these {len(rows)} checkpoints: Pearson's r is
{found["pearson"]["value"]:.2f} ({low:.2f}–{high:.2f}, if they were independent), and the rates differ by
{100 * gap / len(rows):.1f} points on average. Sampling 80 episodes in each alone would give 5.3 points, so
part of this agreement is chance. The threshold was chosen on rollouts of one of these policies, and half
of them were trained in this world model: of 36 checkpoints that were not trained in it, a
[later study](#judge) found imagined success 11 points off.

{table(["checkpoint", "in the world model", "in ManiSkill"], rows)}

Each rate is over 80 episodes, with different starts in the two.

![Success of twelve policies in the world model and in ManiSkill](results/policies.png)"""


GATE_ROWS: Final = {
    "delta_psnr_0_6s": ("delta-PSNR after 0.6 s (dB)", "4.5"),
    "psnr_below_ceiling_1_2s": ("below the tokenizer after 1.2 s (dB)", "3"),
    "done_f1": ("done F1 by frame", "0.9"),
    "done_delay_frames": ("delay of done (frames)", "3"),
    "tcp_error_mm": ("error of the imagined TCP (mm)", ""),
}


def gate_table(columns: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a table with a column for each evaluation of `columns` and the goals beside them."""
    rows = [
        ["false positives", *(counted(c["false_positive_rate"]) for c in columns.values()), "at most 5 %"],
        ["recall", *(counted(c["recall"]) for c in columns.values()), "at least 90 %"],
        ["AUC", *(f"{c['auc']:.2f}" if c.get("auc") else "–" for c in columns.values()), ""],
    ]
    for name, (title, goal) in GATE_ROWS.items():
        digits = 2 if name == "done_f1" else 1
        rows.append([title, *(estimate(c["headline"].get(name), digits) for c in columns.values()), goal])
    return table(["", *columns, "goal"], rows)


def gate(load: Load) -> str:
    found = load("world_model_gate_anchored")
    columns = {"known scenes": found["known"], "unseen scenes": found["unseen"]}
    return f"""Not yet by our own gate: frames and the response to actions exceed the goals, but the world
model predicts too many failures as successes.

{gate_table(columns)}

Anchored dynamics, {found["steps"]:,} steps on 3,300 episodes (96,204 frames), one seed; done at 0.5 for 3
frames. Measured on rollouts of a policy that the model was not trained on: in known scenes half of them with
noise, in unseen scenes without. The sixteen unseen scenes are in no training data; three are known."""


def gate_one_scene(load: Load) -> str:
    found = load("world_model_gate_one_scene")["known"]
    return f"""Yes, by the point estimate: {counted(found["false_positive_rate"])} of the failures are false
positives. The upper end of the interval is above 5 %.

{gate_table({"one scene": found})}

Done at {found["done_threshold"]} for {found["done_frames"]} frames, chosen on 1,120 other rollouts; these
800 were recorded afterwards on new seeds. 75 minutes of one core. This model was trained in three steps;
`gate_one_scene.yaml` is a single training of that size, which has not been run."""


def gate_autoregressive(load: Load) -> str:
    found = load("world_model_gate")["known"]
    return f"""It is far from passed, with less training than the anchored dynamics had.

{gate_table({"nine scenes": found})}

Autoregressive dynamics, 2,200 steps on 2,040 episodes, side view and wrist, one seed."""


def gate_sensitivity(load: Load) -> str:
    found = load("gate_sensitivity")["errors"]
    rows = [[row["error_mm"], counted(row["false_positive_rate"]), counted(row["recall"])] for row in found]
    return f"""To half a millimetre. The simulator repeats the rollouts with their own actions and a slightly
displaced object. A perfect model of physics that locates the object to 2 mm, as is possible at 64 pixels,
would predict a tenth of the failures as successes.

{table(["position error of the object in x and y, std (mm)", "false positives", "recall"], rows)}

480 rollouts."""


def four_tasks(load: Load) -> str:
    found = load("world_model_four_tasks")
    columns = {"all": found, **found["gate_by_task"]}
    rows = [
        [title, *(f"{gate[name]['k']} of {gate[name]['n']}" for gate in columns.values())]
        for title, name in (("false positives", "false_positive_rate"), ("recall", "recall"))
    ]
    rows.append(["AUC", *(f"{gate['auc']:.2f}" for gate in columns.values())])
    head = found["headline"]
    return f"""Somewhat: it tells success from failure with an AUC of {found["auc"]:.2f} after eleven minutes
of training; delta-PSNR after 0.6 s is {estimate(head["delta_psnr_0_6s"])} dB.

{table(["", *columns], rows)}

153 held-out episodes of planners, which are easier than a policy's rollouts; anchored dynamics, one seed."""


def instructions(load: Load) -> str:
    studies = read_cells(ROOT / "experiments" / "instructions.yaml")
    cells = [cell for each in studies if (cell := published(load, "instructions", each.variables["cell"]))]
    rows = [
        [
            cell["seed"],
            DOMAINS[domain],
            task.replace("_", " "),
            kind,
            *told(cell["reads"][reads][domain][task]),
        ]
        for cell in cells
        for domain in DOMAINS
        if domain in cell["reads"]["true"]
        for task in cell["reads"]["true"][domain]
        for reads, kind in (("true", "reads it"), ("false", "does not"))
    ]
    columns = ["false positives", "recall", "AUC", "successes that count under another task's instruction"]
    totals = {
        (reads, name): pooled(cell["reads"][reads] for cell in cells)[name]
        for reads in ("true", "false")
        for name in TOLD
    }
    return f"""Under the instruction that was followed no difference is shown (one seed, tasks pooled): false
positives {totals["true", "false_positive_rate"]} with it and
{totals["false", "false_positive_rate"]} without, recall
{totals["true", "recall"]} and {totals["false", "recall"]}. Under the instruction of another task, drawn from
the same rollouts, {totals["true", "under_another_instruction"]} of the recognised successes still count
with it, and {totals["false", "under_another_instruction"]} without.

{table(["seed", "scenes", "task", "the classifier", *columns], rows)}

Success where the classifier's probability is at least 0.95 for two frames in a row, in recorded frames, not
in imagined ones. The rollouts are of a weak policy (BC of 2,000 steps) with noise: few succeed in pick_place
and move_to_aim. Instructions name objects and containers, and were worded alike in training and here; those
of unseen scenes name others. In ManiSkill the first frame mostly shows the task, so a classifier without the
instruction is wrong only where a policy does what it was not asked for. What reading it changes of PPO's
policies has not been measured."""


def pooled(cells: Iterable[Mapping[str, Any]]) -> dict[str, Proportion]:
    """Add up what classifiers have told in all cells, scenes and tasks."""
    gates = [gate for cell in cells for tasks in cell.values() for gate in tasks.values()]
    return {
        name: Proportion(sum(gate[name]["k"] for gate in gates), sum(gate[name]["n"] for gate in gates))
        for name in TOLD
    }


def told(gate: Mapping[str, Any]) -> list[str]:
    """Return false positives, recall, AUC and confusions of a success classifier, in short."""
    false, recall, confused = (f"{gate[name]['k']} of {gate[name]['n']}" for name in TOLD)
    return [false, recall, "–" if gate["auc"] is None else f"{gate['auc']:.2f}", confused]


def training_rows(variants: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a table with a line a training."""
    rows = [
        [
            name.rsplit("_", 1)[0].replace("_", " "),
            name.rsplit("_", 1)[1],
            f"{row['episodes']:,}",
            f"{row['steps']:,}",
            f"{row['minutes']:.0f}",
            f"{row['parameters'] / 1e6:.1f} M",
            estimate(row["delta_psnr_0_6s"]),
            estimate(row["moving_psnr"]),
            estimate(row["done_f1"], 2),
            f"{row['gate']['auc']:.2f}",
        ]
        for name, row in variants.items()
    ]
    head = [
        "training",
        "seed",
        "episodes",
        "steps",
        "minutes",
        "parameters",
        "delta-PSNR at 15 (dB)",
        "PSNR of what moved (dB)",
        "done F1",
        "AUC of the gate",
    ]
    return table(head, rows)


def ablation(load: Load) -> str:
    return f"""No: neither of them nor both together gain anything measurable. All intervals overlap, and
depth costs twice the arithmetic. Both are off by default.

{training_rows(load("world_model_ablation")["variants"])}

60 held-out episodes, 480 rollouts for the gate, one seed. In about the same time anchored dynamics have 5.7
dB and an AUC of 0.83 on these data ([learning curve](#learning_curve))."""


def ablation_network(load: Load) -> str:
    return f"""AdaLN beats cross-attention in both seeds, so it is the action model's default (the preset
`paper` keeps cross-attention). MaskGIT and self-rollouts gain a little and cost time; without proprioception
pictures are a little better and success is judged a little worse.

{training_rows(load("world_model_ablation_network")["variants"])}

60 held-out episodes, 320 rollouts for the gate (71 failures). *no state* has cross-attention in seed 0 and
AdaLN in seed 1; *maskgit* and *self rollout* have cross-attention. All are far below anchored dynamics."""


def learning_curve(load: Load) -> str:
    return f"""More training: half of the steps loses 3.5 dB of delta-PSNR. Half of the data or of the network
loses little, within the intervals; predicting success (AUC) seems to need all three.

{training_rows(load("learning_curve")["variants"])}

60 held-out episodes, 480 rollouts for the gate, one seed, so small differences mean little. Minutes are
upper bounds, because the machine had other work.

![Learning curve](results/learning_curve.png)"""


def text_dynamics(load: Load) -> str:
    rows = []
    for name, row in load("text_dynamics").items():
        if name == "provenance":
            continue
        kind, steps, seed = name.split("_")
        rows.append(
            [
                kind,
                f"{int(steps):,}",
                seed,
                counted(row["success_holds"]),
                f"{row['nearest_final_tokenizer_lpips']['value']:.2f}",
                estimate(row["auc"], 2),
                f"{row['auc_of_other_starts']['value']:.2f}",
            ]
        )
    example = next(row for name, row in load("text_dynamics").items() if name != "provenance")
    probe, finals = example["probe"]["balanced_accuracy"], 100 * example["success_holds_in_finals"]["share"]
    head = [
        "dynamics",
        "steps",
        "seed",
        "success holds in the goal frame",
        "distance to the nearest final",
        "AUC of the similarity",
        "AUC with other starts' goal frames",
    ]
    return f"""Anchored ones. After 400 steps, which take either kind about two minutes of one core, success
holds in most of their goal frames, and recorded successes end more similar to them than failures do. With
four times the training the difference is small. So the text world model is anchored by default.

{table(head, rows)}

200 starts of a policy's noisy rollouts, none of which the text world models were trained on; one tokenizer,
one dataset. Whether success holds is read by a small network from decoded frames (balanced accuracy
{probe:.2f}; it says so of {finals:.0f} % of recorded final frames). AUC: of all pairs of a success and a
failure, the share in which the success ends more similar to the goal frame of its own start. Batches of 6
(autoregressive, 1.9 million parameters) and 16 (anchored, 7.0 million) clips cost about the same. The
policy's success with either as its reward was not compared."""


REWARDS: Final = {
    "general": "general, alpha 0.9",
    "success": "its part: done",
    "similarity": "its part: similarity",
}


def reward_curves(load: Load) -> str:
    found = load("reward_curves")
    known, unseen = found["known"]["rewards"], found["unseen"]["rewards"]
    rows = []
    for name, row in known.items():
        if name == "rule_based":
            continue
        earned = [f"{row['earned_by'][hand]:.2f}" for hand in ("random", "frozen", "saturated")]
        rows.append(
            [
                REWARDS.get(name, name),
                f"{row['auc']:.2f}, {unseen[name]['auc']:.2f}",
                f"{row['spearman']['value']:.2f}, {unseen[name]['spearman']['value']:.2f}",
                f"{row['earned_by_successes']:.2f}",
                ", ".join(earned),
            ]
        )
    unsure = found["known"]["uncertainty"]
    head = [
        "reward",
        "AUC: known, unseen",
        "Spearman with the rule-based reward",
        "mean reward per frame of successes",
        "mean reward per frame under random, zero, extreme actions",
    ]
    return f"""Done alone separates success from failure best, but gives no signal before it. With similarity
to the goal frame the general reward follows progress best. The embedding reward does nearly as well, but
needs recorded rewards.

{table(head, rows)}

{found["known"]["successes"]} successes and {found["known"]["failures"]} failures in known scenes,
{found["unseen"]["successes"]} and {found["unseen"]["failures"]} in unseen ones, of a policy that the world
model was not trained on. Uncertainty indicates false positives: of {unsure["predicted_successes"]} predicted
successes {unsure["false"]} are failures, and the largest token entropy is higher in a false than in a true
one in {100 * unsure["auc"]["token_entropy"]:.0f} % of all pairs.

![Mean reward along successes and failures](results/reward_curves.png)"""
