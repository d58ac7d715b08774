"""Sections of docs/results.md about policies: an answer in a sentence and one table, from the JSON."""

from collections.abc import Mapping
from typing import Any, Final

from experiments.page.cells import DOMAINS, Load, counted, paired, percents, points, share
from experiments.page.value_cells import SCENES, against, published
from experiments.steps.success import STEPS_AN_ITERATION
from experiments.study import ROOT, read_cells
from lerobot_wmrl.common.files import markdown_table as table
from lerobot_wmrl.improve.progress import CLONED, DISTILLED


def demo(load: Load) -> str:
    found = load("demo")["runs"]
    rows = [
        [run["seed"], policy, *(share(place["policies"][policy]) for place in run["places"].values())]
        for run in found
        for policy in next(iter(run["places"].values()))["policies"]
    ]
    changes = ". ".join(
        f"Seed {run['seed']}, {run['seconds'] / 60:.0f} minutes: "
        + "; ".join(f"{where} {paired(gained(place))}" for where, place in run["places"].items())
        + f"; of the failures of the policy that PPO begins with, the world model predicts "
        f"{counted(run['gate']['false_positive_rate'])} as successes"
        for run in found
    )
    places = found[0]["places"]
    n = next(iter(places.values()))["policies"][CLONED]["n"]
    return f"""The last policy ({DISTILLED}) against its baseline, the first policy trained further on the
same data's successes, on the same starts. {changes}.

{table(["seed", "policy", *places], rows)}

Each rate is over {n} starts. One training a row; [a study](#value_push) compares more methods on more data.
Further BC goes on from the first policy; BC of the same data
[from scratch](pilots.md#is-further-bc-a-weaker-baseline-than-bc-from-scratch) has 74 and 61 %."""


def gained(place: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what the last policy gained over the baseline on the same data."""
    (found,) = (each for each in place["pairs"] if each["after"] == DISTILLED and each["before"] == CLONED)
    return found


def cloning_control(load: Load) -> str:
    found = load("cloning_control")["cloned_from"]
    plan = load("planning")
    rows = [
        [
            f"cloned from {count} planned episodes",
            *(share(row[d]) if d in row else "–" for d in ("ind", "ood")),
        ]
        for count, row in found.items()
    ]
    rows.append(["planning in a world model (`wm_mpc`)", share(plan["ind"]), share(plan["ood"])])
    return f"""With 180 demonstrations without flaws it hardly fails. So neither the cameras nor the network
limit what eight demonstrations reach.

{table(["policy", "known scenes", "unseen scenes"], rows)}

Each rate is over 100 starts (planning: {plan["ind"]["n"]} and {plan["ood"]["n"]}, in another world model);
one seed of cloning."""


def rl_comparison(load: Load) -> str:
    found = load("rl_comparison")
    rows = []
    for name, change in found["mean_change"].items():
        place, _, iteration = name.partition(" ")
        steps = int(iteration) * STEPS_AN_ITERATION
        runs = found["runs"][place]
        for domain, mean in change.items():
            rates = [
                next(p for p in run["ind"] if p["env_steps"] == steps) if domain == "ind" else run["ood"]
                for run in runs
            ]
            minutes = sum(
                next(p for p in run["ind"] if p["env_steps"] == steps)["seconds"] for run in runs
            ) / (60 * len(runs))
            rows.append(
                [
                    {"imagined": "world model", "simulated": "ManiSkill"}[place],
                    DOMAINS[domain],
                    f"{steps:,}",
                    f"{minutes:.0f}",
                    percents(rates),
                    points(mean),
                ]
            )
    last, baseline = found["mean_change"]["imagined 60"], found["mean_change"]["simulated 20"]
    cloned = found["cloned"]
    return f"""It does, over SFT, by {points(last["ind"])} in known scenes and
{points(last["ood"])} in unseen ones. A step in ManiSkill gains more ({points(baseline["ind"])} after 51,200
steps) and takes more than twice as long.

{table(["PPO in", "scenes", "steps", "minutes", "three seeds", "change on the same starts"], rows)}

SFT policy: {share(cloned["ind"])} in known, {share(cloned["ood"])} in unseen scenes; {found["episodes"]}
starts behind each rate; intervals resample starts, not seeds. Time on one core, without collecting data and
training the world model (about an hour on two cores). KL penalty and number of starts were chosen on 200 of
these starts. PPO in ManiSkill was stopped while success still rose, with learning rates tuned in imagination.

![Success in ManiSkill against steps and minutes](results/rl_comparison.png)"""


def imagined_ppo(load: Load) -> str:
    names = {
        "unseen": "SFT policy whose rollouts the world model was not trained on",
        "B": "SFT policy whose rollouts it was trained on",
    }
    return improvement(load("imagined_ppo")["imagined"], names)


def openvla_small(load: Load) -> str:
    found = load("openvla_small")["imagined"]
    sampled, greedy = (found[domain]["policies"]["openvla"] for domain in ("drawn", "ind"))
    return f"""When tokens are sampled, as in PPO: {100 * sampled["cloned"]["share"]:.0f} →
{100 * sampled["trained"]["share"]:.0f} %. With greedy tokens, OpenVLA's default, the gain is
within chance ({100 * greedy["cloned"]["share"]:.0f} → {100 * greedy["trained"]["share"]:.0f} %), and in
unseen scenes there is none. No further BC, the rival of other studies, was run.

{improvement_table(found, {"openvla": "small OpenVLA, 1.0 M parameters"})}

Each rate is over 200 starts; one seed, 153,600 imagined steps."""


def improvement(found: Mapping[str, Any], names: Mapping[str, str]) -> str:
    """Return what PPO in imagination gained for policies that were good already."""
    changes = " and ".join(
        f"{points(row['mean_change'])} in {DOMAINS[domain]} scenes" for domain, row in found.items()
    )
    starts = next(iter(found.values()))["mean_change"]["starts"]
    return f"""A little: {changes}, with a KL penalty five times today's default.

{improvement_table(found, names)}

Each rate is over {starts} starts; one seed. The other two of the study's four policies are not shown."""


def improvement_table(found: Mapping[str, Any], names: Mapping[str, str]) -> str:
    rows = [
        [names[name], DOMAINS[domain], share(row["cloned"]), share(row["trained"]), paired(row)]
        for domain, numbers in found.items()
        for name, row in numbers["policies"].items()
    ]
    return table(["policy", "scenes", "SFT", "after PPO in imagination", "on the same starts"], rows)


def planning(load: Load) -> str:
    found = load("planning")
    return f"""Not on this task, with a world model of 2,200 episodes: `wm_mpc`, which imagines action
sequences and executes the best one, beats every policy that was trained in it, but not
[BC of 180 planned episodes](#cloning_control). With one of 308 episodes it had 76 and 72 % in a pilot, PPO
in imagination 87 and 82.

{table(["scenes", "success of `wm_mpc`"], [[DOMAINS[d], counted(found[d])] for d in ("ind", "ood")])}

One world model. An episode takes about three seconds on one core; a plan imagines some 10,000 frames."""


def synthetic_data(load: Load) -> str:
    found = load("synthetic_data")
    names = {
        "cloned": "eight demonstrations",
        "imagined": "160 imagined successes of that policy",
        "simulated": "160 ManiSkill successes of that policy",
    }
    rows = [
        [
            title,
            *(share(found[kind][d]) for d in ("ind", "ood")),
            "" if kind == "cloned" else paired(found[kind]["ind"]["from_cloned"]),
        ]
        for kind, title in names.items()
    ]
    return f"""It does, and more than from ManiSkill's successes. An imagined success is stricter here (done
probability of 0.95 in two consecutive frames); whether that explains the difference has not been tested.

{table(["cloned from", "known scenes", "unseen scenes", "known scenes, on the same starts"], rows)}

Each rate is over {found["episodes"]} starts; one seed."""


DRIVEN: Final = {
    "driven_cloning": "driven by keys in the world model",
    "optimal_cloning": "planned in ManiSkill",
    "human_like_cloning": "planned in ManiSkill, with pauses and detours",
}
"""Method → what its policy is cloned from."""


def driven(load: Load) -> str:
    """Return the section: success of policies cloned from driven demonstrations, beside planned ones."""
    rows = []
    for each in read_cells(ROOT / "experiments" / "driven.yaml"):
        cell = published(load, "driven", each.variables["cell"])
        if not cell:
            continue
        reference = cell["methods"]["driven_cloning"]
        for name, title in DRIVEN.items():
            found = cell["methods"][name]
            rates = [
                f"{100 * found[domain]['share']:.0f} %"
                if name == "driven_cloning"
                else against(found[domain], reference[domain])
                for domain in SCENES
            ]
            rows.append([cell["count"], title, cell["seed"], *rates])
    return f"""Policies cloned from as many demonstrations of each kind, on the same starts. Changes are
against the first row:

{table(["episodes", "demonstrations", "seed", "known scenes", "unseen scenes"], rows)}

A scripted person holds keys down for what a planner in the world model finds, which changes what PPO's
policy would do, does again what fails, and ends an episode at success. LeRobot's own `lerobot-record`
records it in real time, without the simulator."""
