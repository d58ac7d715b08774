"""What imagination is worth: its sections of docs/results.md."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any, Final

import numpy as np
from scipy.stats import ttest_1samp

from experiments.page.cells import DOMAINS, Load, points
from experiments.page.value_cells import (
    BASELINES,
    BUDGET,
    PARTS,
    REAL_EPISODES,
    SCENES,
    SECOND_PARTS,
    SECOND_STUDY,
    STUDY,
    TASKS_GROUPS,
    TASKS_PARTS,
    TASKS_STUDY,
    TITLES,
    Cell,
    Groups,
    against,
    best,
    best_pair,
    gain,
    gains,
    groups,
    having,
    mean,
    mean_of,
    measured,
    minutes,
    outcomes,
    published,
    shares,
)
from experiments.study import ROOT, read_cells
from lerobot_wmrl.common.files import markdown_table as table

AIMED_GAIN: Final = 0.1
"""What was aimed at: how much more often methods with a world model succeed than those without one."""

AIMED_SUCCESS: Final = (0.95, 0.88)
"""What was aimed at for the distilled planner: success in known and in unseen scenes."""


def value_push(load: Load) -> str:
    """Return the section, with the methods of all studies on the same data, and the figure."""
    found = groups(load)
    cells = [cell for each in found.values() for cell in each]
    policy, planned = (mean_of(cells, method, "seconds_an_episode") for method in ("imagined_ppo", "planned"))
    return f"""{comparison(found)}

{trained_longer(found)}

{aims(found)}
In most cells all that the planner distilled after PPO needs, PPO included, was run again. In these its
recording was then another one of the same budget: {recorded_anew(found, "ppo_distilled")}.

PPO in imagination begins from filtered BC, or from BC of the demonstrations where that succeeds more often
in the world model (256 starts or all, McNemar's test): {begun(cells)}. The gate was switched off in it. PPO
in ManiSkill begins from BC of the demonstrations; its policy learns from the second iteration on. When it
learnt from the fourth of ten on, it had 70 and 60 % with 8 demonstrations and 300 rollouts, 88 and 74 %
with 25, and 96 and 79 % with 50 (three seeds each). Its learning rates and KL penalty are those that were
tuned in imagination. With 8 and with 50 demonstrations it was run again on another machine, demonstrations
and BC included. {from_the_same_start(cells)} PPO in imagination alone is not clearly better than PPO in
ManiSkill from 25 demonstrations on.

Planning changes what PPO's policy would do, and plans anew after eight actions. An episode of it takes
{planned:.1f} s on one core, simulator included, one of the policy {policy:.1f} s.

Both rules were chosen after a first run of seed 0's cells, on its models and other starts
([pilot](pilots.md#where-ppo-begins-and-planning-after-it)). In seed 0's cells planning adds to PPO in
{planning_adds([cell for cell in cells if not cell["seed"]])} rates, in those of other seeds in
{planning_adds([cell for cell in cells if cell["seed"]])}.

RECAP and the distilled planner were moved into a [study of their own](#value_others) after a first run of two
cells, in which others of their kind did better.

No study has cells without rollouts or with play. The demonstrations have pauses and detours; BC of `optimal`
ones is better than much of this table, in [two](#cloning_control) [studies](#driven).

![Success against real episodes](images/value_push.png)"""


def aims(found: Groups) -> str:
    """Return which of the study's aims are reached, with which budgets."""
    above, planner, most = [], [], 0.0
    for budget, cells in found.items():
        gained = [gain(cells, *best_pair(cells, domain), domain) for domain in SCENES]
        if all(each.mean >= AIMED_GAIN and each.low > 0 for each in gained):
            above.append(spoken(budget))
        else:
            most = max(most, mean(cells, best(cells, BASELINES, "ind"), "ind"))
        if not measured(cells, ["ppo_distilled"]):
            continue
        rates = [mean(cells, "ppo_distilled", domain) for domain in SCENES]
        if all(rate >= aimed for rate, aimed in zip(rates, AIMED_SUCCESS, strict=True)):
            planner.append(f"{spoken(budget)}, in {minutes(cells, 'ppo_distilled')} minutes")
    known, unseen = (f"{100 * rate:.0f}" for rate in AIMED_SUCCESS)
    return f"""We had aimed at {100 * AIMED_GAIN:.0f} points more than the best method without a world model,
in known and in unseen scenes, with two of three numbers of demonstrations. The means reach that with
{listed(above)} alone (for what seeds bear out see below), where the best of those is BC trained for longer,
which was not run with every budget. With more demonstrations or rollouts, less is left to gain: the best
method without one reaches up to {100 * most:.0f} % in known scenes. Of the planner distilled after PPO we
had expected {known} and {unseen} % within 30 minutes. It reaches both rates with {listed(planner)}."""


def listed(parts: Sequence[str]) -> str:
    """`a; b`, or `no budget`."""
    return "; ".join(parts) or "no budget"


def spoken(group: tuple[Any, ...]) -> str:
    """`8 demonstrations and 300 rollouts`, after the task where the group has one."""
    *task, demonstrations, rollouts = group
    return ", ".join([*task, f"{demonstrations} demonstrations and {rollouts:,} rollouts"])


def recorded_anew(found: Groups, method: str) -> str:
    """Return in which cells a method learnt from other episodes of the same budget than other rows."""
    return listed(
        [
            f"{spoken(group)}, seed {cell['seed']} ({own} successes, the others {cell['real_successes']})"
            for group, cells in found.items()
            for cell in cells
            if (own := cell["recorded_anew"].get(method)) is not None
        ]
    )


def from_the_same_start(cells: Sequence[Cell]) -> str:
    """Return what imagination adds to PPO where both kinds began from BC of the demonstrations."""
    both = [cell for cell in cells if cell["start"] == "cloning" and "simulated_ppo" in cell["methods"]]
    if not both:
        return ""
    known, unseen = (
        f"{100 * gain(both, 'imagined_ppo', 'simulated_ppo', domain).mean:.0f}" for domain in SCENES
    )
    return f"""In the {len(both)} cells where both kinds of PPO begin from BC of the demonstrations, that in
imagination succeeds more often by {known} points in known and {unseen} in unseen scenes."""


def planning_adds(cells: Sequence[Cell]) -> str:
    """`7 of 8`: in how many rates planning after PPO is above PPO."""
    added = [each for domain in SCENES for each in gains(cells, "planned", "imagined_ppo", domain)]
    return f"{sum(each > 0 for each in added)} of {len(added)}"


def begun(cells: Sequence[Cell]) -> str:
    """`from the demonstrations alone in 2 of 9 cells`."""
    alone = sum(cell["start"] == "cloning" for cell in cells)
    return f"from the demonstrations alone in {alone} of {len(cells)} cells"


def value_pick_place(load: Load) -> str:
    """Return the section."""
    found = groups(load, SECOND_STUDY, SECOND_PARTS)
    cells = [cell for each in found.values() for cell in each]
    imagined, real = (
        100 * float(np.mean(shares))
        for shares in (
            [cell["imagined"][cell["start"]] for cell in cells],
            [cell["methods"][cell["start"]]["ind"]["share"] for cell in cells],
        )
    )
    return f"""{comparison(found)}

{trained_longer(found)}

The policy that PPO begins from succeeds from {imagined:.0f} % of the recorded starts in imagination, and from
{real:.0f} % of the known ones in ManiSkill: the world model recognises few of its successes. {misled(cells)}

The discount 0.989 was chosen because of seed 200000. From filtered BC it is better than 0.97 with that seed,
and worse with seed 0, in the same world model too ([pilot](pilots.md#pick-and-place)); with seed 100000 the
rows of the two discounts begin from different policies there. From the longer BC it is better with seeds
100000 and 200000, and as good with seed 0.

In unseen scenes all methods mostly fail: 50 demonstrations in three scenes teach grasping in these. Not
compared: PPO in ManiSkill and longer BC where the table has no row of them; longer BC of the demonstrations
alone; and planning at test time, which failed in a [pilot](pilots.md#pick-and-place), on whose episodes the
done threshold was chosen too."""


def value_tasks(load: Load) -> str:
    """Return the section."""
    return f"""{comparison(groups(load, TASKS_STUDY, TASKS_PARTS, TASKS_GROUPS), TASKS_GROUPS)}

No setting was tried in these tasks. The number of demonstrations is the one with which push gains most. No
control was run: wrong labels, wrong actions, and longer BC than three times as many steps."""


def misled(cells: Sequence[Cell]) -> str:
    """Return in which cells the world model preferred the policy that succeeds less often."""
    said = []
    for cell in cells:
        known, unseen = (
            {name: f"{100 * cell['methods'][name][domain]['share']:.0f}" for name in ("cloning", "filtered")}
            for domain in SCENES
        )
        if cell["start"] == "cloning" and int(known["cloning"]) < int(known["filtered"]):
            said.append(
                f"With seed {cell['seed']} it preferred BC of the demonstrations ({known['cloning']} and "
                f"{unseen['cloning']} %) to filtered BC ({known['filtered']} and {unseen['filtered']} %), "
                "and PPO began from the worse one."
            )
    return " ".join(said)


def comparison(found: Groups, by: Sequence[str] = REAL_EPISODES) -> str:
    """Return for each group the best with and without a world model, and a table of all methods."""
    rows = [
        [*group, title, *(shares(cells, method, domain) for domain in SCENES), minutes(cells, method)]
        for group, cells in found.items()
        for method, title in TITLES.items()
        if method in measured(cells, TITLES)
    ]
    starts = len(outcomes(next(iter(found.values())), "cloning", "ind")[0])
    return f"""The best method with a world model against the best without one, on as many real episodes and
the same starts:

{best_gains(found, by)}

{beyond_seeds(found)}

All methods:

{table([*by, "method", "known scenes", "unseen scenes", "minutes"], rows)}

Success of each seed over {starts} starts; with more than one seed, their mean. Intervals count starts, and
seeds where there are several. Minutes are those of training on one core, without recording (Dyna records
while it trains, and that is counted). The best method of each kind is chosen on the starts that are reported.
PPO in imagination and the methods below it use a world model."""


def best_gains(found: Groups, by: Sequence[str]) -> str:
    """Return a table of what the best method with a world model gains over the best without one."""
    rows = []
    for group, cells in found.items():
        for domain in SCENES:
            pair = best_pair(cells, domain)
            rows.append(
                [
                    *group,
                    DOMAINS[domain],
                    *(TITLES[method] for method in reversed(pair)),
                    points(asdict(gain(cells, *pair, domain))),
                    ", ".join(str(round(100 * each)) for each in gains(cells, *pair, domain)),
                ]
            )
    return table([*by, "scenes", "best without", "best with", "gain", "by seed"], rows)


def trained_longer(found: Groups) -> str:
    """Return what is left of the gains in the cells in which BC was also trained for longer."""
    longer = having(found, "longer_filtered")
    if not longer:
        return ""
    which = listed(
        [
            f"{spoken(group)}, seed{'s' if len(cells) > 1 else ''} "
            + ", ".join(str(cell["seed"]) for cell in cells)
            for group, cells in longer.items()
        ]
    )
    rises = [
        rise
        for cells in longer.values()
        for domain in SCENES
        for rise in gains(cells, "longer_filtered", "filtered", domain)
    ]
    left = ""
    if longer != found:
        left = f" What is left of the gains there:\n\n{best_gains(longer, REAL_EPISODES)}"
    alone = "in all cells" if longer == found else f"in some cells alone: {which}"
    return f"""**Was BC stopped too early?** Filtered BC for three times as many steps was run last,
{alone}. In {sum(rise > 0 for rise in rises)} of {len(rises)} rates it succeeds more
often, by {100 * min(rises):.0f} to {100 * max(rises):.0f} points.{left}

{own_recordings(longer, "longer_filtered")}

{from_longer(longer)}"""


def own_recordings(found: Groups, method: str) -> str:
    """Say in which cells longer BC learnt from other episodes of the same budget than other rows."""
    if not any(cell["recorded_anew"].get(method) for cells in found.values() for cell in cells):
        return "The longer BC learnt from the same episodes as the other rows."
    return f"""The longer BC learnt from a recording of its own, of the same budget, in these cells:
{recorded_anew(found, method)}."""


def from_longer(found: Groups) -> str:
    """Return a table of what methods in imagination make of longer BC, from which they begin."""
    begun = ("longer_imagined_ppo", "longer_ppo_distilled", "longer_discounted_ppo")
    rows = [
        [
            *group,
            DOMAINS[domain],
            TITLES[method],
            shares(own, "longer_filtered", domain),
            shares(own, method, domain),
            points(asdict(gain(own, method, "longer_filtered", domain))),
        ]
        for group, cells in having(found, "longer_filtered").items()
        for method in measured(cells, begun)
        for own in [[cell for cell in cells if method in cell["methods"]]]
        for domain in SCENES
    ]
    if not rows:
        return "PPO and the planner have not begun from it yet."
    columns = [*REAL_EPISODES, "scenes", "method", "longer BC", "after the method", "gain"]
    return f"What begins from it in imagination:\n\n{table(columns, rows)}"


def beyond_seeds(found: Groups) -> str:
    """Return which gains of the best method are above 0 by Student's t over the seeds alone."""
    if all(len(cells) < 3 for cells in found.values()):
        return "One or two seeds say little of others."
    certain, compared = [], 0
    for group, cells in found.items():
        for domain in SCENES:
            each = gains(cells, *best_pair(cells, domain), domain)
            compared += len(each) > 2
            if len(each) > 2 and (low := ttest_1samp(each, 0).confidence_interval().low) > 0:
                certain.append(
                    f"{spoken(group)}, {DOMAINS[domain]} scenes (lower end {100 * low:.0f} points)"
                )
    which = f": {listed(certain)}" if certain else ""
    return f"""These intervals draw starts and seeds, and with three seeds they are too narrow. By Student's t
over the gains of three seeds alone, the 95 % interval of {len(certain)} of {compared} gains
excludes 0{which}. This is not corrected for their number."""


def rows_above(methods: Sequence[str], load: Load, study: str = STUDY, parts: Sequence[str] = PARTS) -> str:
    """Return the section of a study whose numbers are in the table of another one, `study`."""
    cells = [cell for each in groups(load, study, parts).values() for cell in each]
    titles = ", ".join(f'"{TITLES[method]}"' for method in measured(cells, methods))
    return f"Its rows are in [the table above](#{study}): {titles}."


def value_others(load: Load) -> str:
    """Return the section: where its methods are, and success after PPO without a reward."""
    rows = [
        [
            *budget,
            *(against(others["methods"]["unrewarded"][domain], before[domain]) for domain in SCENES),
        ]
        for cell, budget, before in improved(load)
        if (others := published(load, "value_others", cell))
    ]
    return f"""{rows_above(["conditioned", "distilled"], load)}

PPO in which an episode is rewarded only if all its frames are done, against the policy before it:

{table([*BUDGET, "known scenes", "unseen scenes"], rows)}"""


def improved(load: Load) -> Iterator[tuple[str, list[Any], Cell]]:
    """Yield the published cells of the study: name, budget and seed, success of the policy before PPO."""
    for each in read_cells(ROOT / "experiments" / f"{STUDY}.yaml"):
        name = each.variables["cell"]
        if cell := published(load, STUDY, name):
            budget = [cell["demonstrations"], cell["rollouts"], cell["seed"]]
            yield name, budget, cell["methods"][cell["start"]]
