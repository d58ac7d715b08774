"""What the report and the command say: what was gained, and whether the world model can be trusted."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_wmrl.common.stages import FAILED, read_record
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.envs.lerobot_env import counts_resets
from lerobot_wmrl.evaluation.comparison import Pair
from lerobot_wmrl.evaluation.gate import DOUBTFUL_AUC
from lerobot_wmrl.evaluation.report import seen_line
from lerobot_wmrl.improve.findings import few_failures, one_sided_tasks
from lerobot_wmrl.improve.plan import STRICT_DONE_THRESHOLD
from lerobot_wmrl.improve.progress import CLONED, SFT, Progress
from lerobot_wmrl.improve.results import (
    Place,
    read_check,
    read_gate,
    read_place,
    read_selection,
)
from lerobot_wmrl.improve.stage_names import StageName
from lerobot_wmrl.rl.selection import REAL, best_iteration, success


def compared(progress: Progress) -> Place:
    """Read the comparison that ends an improvement."""
    real = progress.plan.config.real_env
    where = "in imagination, from frames of the dataset" if real is None else f"in {real.type}"
    return read_place(where, progress.plan.folder(StageName.COMPARISON), [*progress.policies])


def read_choice(progress: Progress) -> Place | None:
    """Read the comparison that chooses the policy to use; None without selection."""
    real = progress.plan.config.real_env
    if real is None or not progress.plan.config.selects:
        return None
    return read_place(f"in {real.type}", progress.plan.folder(StageName.CHOICE), [*progress.policies])


def rollouts_line(progress: Progress) -> list[str]:
    """Say how many of the recorded rollouts succeed; nothing without rollouts."""
    config = progress.plan.config
    if config.real_env is None or not config.rollouts:
        return []
    success = progress.learnt.table.success[[*progress.plan.rollout_numbers()]]
    return [
        f"{len(success)} rollouts of the {SFT} in {config.real_env.type}, exploration {config.exploration}: "
        f"{success.sum()} succeed"
    ]


def lacks(progress: Progress) -> list[str]:
    """Say what the data lacks, rollouts included."""
    missing = progress.plan.findings.missing
    if not progress.plan.config.rollouts:
        return missing
    learnt = progress.learnt.chosen()
    few = few_failures(learnt, "Record more rollouts, with more exploration")
    return [*missing, *one_sided_tasks(learnt), *few]


def verdict(progress: Progress, places: Sequence[Place]) -> str:
    """Say in a few lines which policy to use, and how it compares with each other one, and where."""
    paths, chosen = progress.policies, progress.chosen()
    paragraphs = []
    for place in places:
        rates = [f"- {title}: {rate}, `{paths[title]}`" for title, rate in place.rates.items()]
        changes = [f"- {line}" for line in pair_lines(place, chosen)]
        paragraphs.append("\n".join([f"Success {place.name}, on the same starts:", *rates, *changes]))
    return "\n\n".join(
        [
            *paragraphs,
            decided_at(places),
            f"The world model: {trust(progress)}",
            *lacks(progress),
            *reservations(progress),
            choice_line(progress),
        ]
    )


def choice_line(progress: Progress) -> str:
    """Say which policy to use, and why."""
    chosen, choice = progress.chosen(), read_choice(progress)
    path = progress.policies[chosen]
    if choice is None:
        return (
            f"The last policy: {chosen}, {path}. RL can make a policy worse: compare it with the earlier "
            "ones before you use it."
        )
    shown = ", ".join(f"{title} {rate}" for title, rate in choice.rates.items())
    return (
        f"Policy to use: {chosen}, {path}. None succeeded more often {choice.name}, {set_aside(progress)}: "
        f"{shown}. Of equally good ones it is the earliest."
    )


def set_aside(progress: Progress) -> str:
    """Say on which starts a choice was made."""
    real = progress.plan.config.real_env
    if real is not None and counts_resets(real):
        return f"on the first starts of {real.type}, on which the policies are compared too"
    return "on starts set aside for this"


def rl_line(progress: Progress) -> list[str]:
    """Say which checkpoint of RL is compared, and how others did; nothing if none was chosen."""
    records = read_selection(progress.plan.out)
    if not records:
        return []
    best = best_iteration(records, REAL)
    shown = ", ".join(f"{iteration}: {success(records[iteration], REAL)}" for iteration in sorted(records))
    which = f"that of iteration {best}" if best else "iteration 0, the policy that RL began with"
    return [
        f"RL's checkpoint is {which}: none succeeded more often in the real environment. Success by "
        f"iteration, {set_aside(progress)}: {shown}."
    ]


def pair_lines(place: Place, about: str | None = None) -> list[str]:
    """Say what the policies gained over one another; only pairs with the one it is `about`, if given."""
    return [
        f"{pair.after}, against {pair.before}: {pair.change.gained} starts gained, {pair.change.lost} lost, "
        f"p = {pair.p_value:.2g}: {decision(pair)}"
        for pair in place.comparison.pairs()
        if about in (None, pair.before, pair.after)
    ]


def decision(pair: Pair) -> str:
    """Say whether the second policy of a pair is decided to be better or worse than the first."""
    if pair.better is None:
        return "not decided"
    return "better" if pair.better == pair.after else "worse"


def decided_at(places: Sequence[Place]) -> str:
    """Say how the pairs of policies are decided, everywhere alike."""
    comparison = places[0].comparison
    level = comparison.pairs()[0].level
    return (
        f"McNemar's exact test decides a pair where p is at most {level:.2g}: {comparison.alpha} over the "
        "number of pairs."
    )


def reservations(progress: Progress) -> list[str]:
    """Say what a reader must know beside the success rates."""
    plan, notes = progress.plan, []
    if plan.config.real_env is None:
        notes.append(
            "This is what the world model predicts, and shows nothing about the real world. Run the policies "
            "there, label what they did, and run the command again on all episodes, with the better policy "
            "as --policy.path and another --output_dir."
        )
    if reason := read_record(plan.out, StageName.RL).get(FAILED):
        kept = progress.has_trained and not progress.kept_start
        left = "A checkpoint from before that is compared" if kept else "It left no policy"
        notes.append(f"RL stopped ({plan.out / 'logs' / 'rl.log'}). {left}. {reason}")
    if progress.kept_start:
        notes.append(
            "RL gained nothing: no checkpoint succeeded more often in the real environment than the policy "
            "that it began with, whatever imagination says of them."
        )
    if plan.config.distils and not progress.has_distilled:
        log = plan.out / "logs" / "distilled.log"
        notes.append(
            f"Fitting the policy to a planner failed ({log}), and left no policy. To try again, choose "
            "another output_dir."
        )
    return notes


def start_line(progress: Progress) -> list[str]:
    """Say which policy RL began with, and why; nothing if there was no choice."""
    if not progress.plan.clones:
        return []
    rates = read_place("in imagination", progress.plan.folder(StageName.START), [CLONED, SFT]).rates
    shown = ", ".join(f"{title} {rate}" for title, rate in rates.items())
    return [
        f"RL began with: {progress.start()}. Success in imagination, from frames of the dataset: {shown}. "
        f"The {SFT} is taken only if it is better by the same test."
    ]


def trust(progress: Progress) -> str:
    """Say how well the world model tells recorded successes from failures."""
    check = read_check(progress.plan.out)
    wins, losses = check["successes"], check["failures"]
    whose = "rollouts" if Path(check["dataset"]) == progress.plan.folder(StageName.MERGED) else "episodes"
    held_out = check["split"] == "validation"
    if progress.plan.config.check.given:
        kind = f"episodes of {progress.plan.config.check.name}"
    else:
        kind = f"held-out {whose}" if held_out else f"{whose} (most of which it has learnt from)"
    if not wins or not losses:
        return (
            f"Unknown: of the {kind} {wins} succeed and {losses} fail, and both are needed. Record more."
            f"{taken_instead(progress)}"
        )
    false, recall = Proportion(check["false_positives"], losses), Proportion(check["true_positives"], wins)
    text = (
        f"On {wins + losses} {kind}: false positives {false}, recall {recall}, AUC {check['auc']:.2f} (the "
        "probability that a success scores higher than a failure; 0.5 is chance)."
    )
    if check["auc"] < DOUBTFUL_AUC:
        text += " That is not enough to trust its reward: record more episodes, failures above all."
    if (seen_auc := check.get("seen_auc")) is not None:
        larger = " `--size=cpu` has larger frames." if progress.plan.sizes.could_be_larger else ""
        text += f" {seen_line(seen_auc, larger)}"
    return text + taken_instead(progress)


def gate_line(progress: Progress) -> list[str]:
    """Say how well it judged fresh rollouts in the real environment before RL; nothing without any."""
    record = read_gate(progress.plan.out)
    if record is None:
        return []
    false, recall = gate_rates(record["fresh"])
    return [
        f"On {false.n + recall.n} fresh rollouts of the policy that RL began with: false positives {false}, "
        f"recall {recall}."
    ]


def gate_warnings(progress: Progress) -> list[str]:
    """Say what the gate warned of."""
    record = read_gate(progress.plan.out)
    if record is None or not record["warning"]:
        return []
    if not record["failed"]:
        return [f"{record['warning']}."]
    return [
        f"{record['warning']}. Success in imagination may rise with nothing behind it: trust only success in "
        "the real environment."
    ]


def gate_rates(gate: Mapping[str, Any]) -> list[Proportion]:
    """Return false positive rate and recall of a gate, as JSON has it."""
    return [Proportion.from_json(gate[name]) for name in ("false_positive_rate", "recall")]


def taken_instead(progress: Progress) -> str:
    """Say where imagination saw success, if not at the strict threshold."""
    point = progress.relaxed_criterion()
    if point is None:
        return ""
    false, recall = gate_rates(point)
    return (
        f" Recall is 0 at done_threshold={STRICT_DONE_THRESHOLD}: imagination took "
        f"done_threshold={point['done_threshold']} and done_frames={point['done_frames']}, chosen on the "
        f"same episodes (false positives {false}, recall {recall})."
    )
