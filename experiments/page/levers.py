"""What each lever changes: the published studies side by side, at the top of docs/results.md."""

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from experiments.page import value_cells
from experiments.page.cells import Load
from experiments.page.value_cells import REAL_EPISODES, SCENES, Cell, gain, groups
from lerobot_wmrl.common.files import markdown_table as table


class Source(NamedTuple):
    """Where a lever was pulled.

    Args:
        study: the study.
        parts: studies whose cells add methods to it.
        setting: task and policy, in which `{task}` is that of a cell.
        by: what the cells of a row have in common.
        names: what methods are called here that other studies call otherwise.
    """

    study: str
    parts: Sequence[str] = ()
    setting: str = "push, cnn"
    by: Sequence[str] = REAL_EPISODES
    names: Mapping[str, str] = MappingProxyType({})


class Lever(NamedTuple):
    """A change of the method.

    Args:
        change: what is changed, and what is done without it.
        before: the method without it.
        after: the method with it.
        sources: where both were run.
    """

    change: str
    before: str
    after: str
    sources: Sequence[Source]


START: Final = "start"
"""The policy that PPO begins from, BC of the demonstrations or filtered BC."""

PUSH: Final = Source(value_cells.STUDY, value_cells.PARTS)
SAME: Final = Source("value_same_recordings")
REWARDS: Final = Source(
    "value_rewards", names={START: "filtered", "imagined_ppo": "success", "ppo_distilled": "distilled"}
)
TASKS: Final = Source(
    value_cells.TASKS_STUDY, value_cells.TASKS_PARTS, "{task}, cnn", value_cells.TASKS_GROUPS
)
PICK_PLACE: Final = Source(value_cells.SECOND_STUDY, value_cells.SECOND_PARTS, "pick and place, cnn")
ACT: Final = Source("value_act", setting="push, ACT", names={START: "filtered"})
CODES: Final = Source("codes")

LEVERS: Final = {
    "Without a world model": (
        Lever("BC of successful rollouts too", "cloning", "filtered", (PUSH, TASKS, PICK_PLACE)),
        Lever(
            "filtered BC, three times as many steps",
            "filtered",
            "longer_filtered",
            (REWARDS, SAME, TASKS, ACT),
        ),
        Lever("BC of the demonstrations, three times as many steps", "cloning", "longer", (SAME, TASKS)),
        Lever("weights in place of the filter (RA-BC)", "filtered", "weighted", (PUSH, PICK_PLACE)),
        Lever("advantage as an input in place of the filter (RECAP)", "filtered", "conditioned", (PUSH,)),
        Lever("rollouts without noise", "filtered", "noiseless", (PUSH,)),
        Lever("rollouts in three rounds", "longer_filtered", "iterated", (PUSH, PICK_PLACE)),
    ),
    "Reinforcement learning in imagination": (
        Lever(
            "PPO, against the policy that it begins from",
            START,
            "imagined_ppo",
            (REWARDS, SAME, TASKS, PICK_PLACE, ACT),
        ),
        Lever(
            "PPO, against filtered BC of three times as many steps",
            "longer_filtered",
            "imagined_ppo",
            (REWARDS, SAME, TASKS, ACT),
        ),
        Lever(
            "PPO in imagination in place of PPO in ManiSkill",
            "simulated_ppo",
            "imagined_ppo",
            (PUSH, PICK_PLACE),
        ),
        Lever(
            "PPO from longer filtered BC in place of filtered BC",
            "imagined_ppo",
            "longer_imagined_ppo",
            (PUSH,),
        ),
        Lever(
            "PPO, against the longer filtered BC that it begins from",
            "longer_filtered",
            "longer_imagined_ppo",
            (PICK_PLACE,),
        ),
        Lever(
            "PPO from longer filtered BC, discount 0.989 in place of 0.97",
            "longer_imagined_ppo",
            "longer_discounted_ppo",
            (PICK_PLACE,),
        ),
        Lever("Dyna rounds in place of all rollouts at once", "imagined_ppo", "dyna", (PUSH,)),
        Lever("GRPO in place of PPO", "success", "grpo", (REWARDS,)),
        Lever("LFQ codes in place of FSQ", "ppo_fsq", "ppo_lfq", (CODES,)),
    ),
    "Rewards, in place of success alone": (
        Lever("general, potential form", "success", "general", (REWARDS,)),
        Lever("general, absolute form (the paper's)", "success", "absolute", (REWARDS,)),
        Lever("similarity to the goal frame", "success", "similarity", (REWARDS,)),
        Lever("learnt, hidden state of the world model", "success", "embedding", (REWARDS,)),
        Lever("learnt, frames", "success", "proxy", (REWARDS,)),
    ),
    "Planning and distillation": (
        Lever("planning at test time, after PPO", "imagined_ppo", "planned", (PUSH,)),
        Lever("planner distilled after PPO", "imagined_ppo", "ppo_distilled", (REWARDS, SAME, TASKS)),
        Lever("planner distilled in place of PPO", "imagined_ppo", "distilled", (PUSH, ACT)),
        Lever("cloning imagined successes in place of PPO", "imagined_ppo", "imagined_cloning", (PUSH,)),
    ),
}
"""Levers by what they are a part of."""

INTRODUCTION: Final = """\
Each row is one change of the method, on the same starts (300 known, 300 unseen): points gained or lost, with
the bootstrap's 95 % interval over starts and seeds. Intervals of two or three seeds are too narrow for other
seeds, and of so many rows some exclude 0 by chance: one in twenty, if no change did anything. Episodes are
demonstrations and rollouts; with an asterisk the methods learnt from recordings of their own, of equal
budget. Methods and limits are in the sections below, where [twice as many steps](#value_time_limit),
[controls](#value_controls) and [four tasks](#value_four_tasks) are compared in other ways."""

COLUMNS: Final = ["change", "task, policy", "episodes", "seeds", "known scenes", "unseen scenes"]


def section(load: Load) -> str:
    """Return the chapter, a table for each kind of lever."""
    parts = [
        f"**{kind}**\n\n" + table(COLUMNS, [row for lever in levers for row in rows(load, lever)])
        for kind, levers in LEVERS.items()
    ]
    return "\n\n".join([" ".join(INTRODUCTION.split()), *parts])


def rows(load: Load, lever: Lever) -> Iterator[list[str | int]]:
    """Yield a row for each task and number of real episodes with which a lever was pulled."""
    for source in lever.sources:
        for cells in groups(load, source.study, source.parts, source.by).values():
            named = [{**cell, "methods": by_name(cell, source)} for cell in cells]
            if both := [cell for cell in named if {lever.before, lever.after} <= cell["methods"].keys()]:
                yield [f"[{lever.change}](#{source.study})", *row(both, source, lever)]


def by_name(cell: Cell, source: Source) -> dict[str, Any]:
    """Return the methods of a cell by the names that levers have for them."""
    methods = cell["methods"]
    names = {START: cell.get("start"), **source.names}
    return {**methods, **{name: methods[own] for name, own in names.items() if own in methods}}


def row(cells: Sequence[Cell], source: Source, lever: Lever) -> list[str | int]:
    """Return where a lever was pulled, with how many seeds, and what it changes in SCENES."""
    first = cells[0]
    anew = [cell["recorded_anew"].get(method) for cell in cells for method in (lever.before, lever.after)]
    return [
        source.setting.format_map(first).replace("_", " "),
        f"{first['demonstrations']} + {first['rollouts']}{'' if anew.count(None) == len(anew) else ' *'}",
        len(cells),
        *(points(cells, lever, domain) for domain in SCENES),
    ]


def points(cells: Sequence[Cell], lever: Lever, domain: str) -> str:
    """`+16.5 (12.2 to 21.3)`"""
    found = gain(cells, lever.after, lever.before, domain)
    mean, low, high = (f"{100 * each:+.1f}".replace("-", "−") for each in (found.mean, found.low, found.high))
    return f"{mean} ({low} to {high})"
