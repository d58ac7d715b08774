"""The paper's quantizer, and success by the goal frame, beside ours: the section of docs/results.md."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from experiments.page.cells import DOMAINS, Load, counted, estimate
from experiments.page.from_one_policy import changes, tables
from experiments.page.value_cells import SCENES, Cell, groups, mean, shares
from lerobot_wmrl.common.files import markdown_table as table

STUDY: Final = "codes"
TIME_LIMIT: Final = "value_time_limit"

TITLES: Final = {
    "filtered": "filtered BC, before PPO",
    "ppo_fsq": "PPO, world model with FSQ codes",
    "ppo_lfq": "PPO, world model with LFQ codes",
}
"""Methods in the order of the table."""

QUANTIZERS: Final = {"fsq": "FSQ", "lfq": "LFQ"}
MEASURES: Final = {"classifier": "success classifier", "goal": "similarity to the goal frame"}
CHOSEN: Final = "chosen"
"""The dataset in which the thresholds were chosen, among those of goal_distance."""

LIMITS: Final = """\
FSQ has 15,625 codes in six factors of five, LFQ 16,384 in two of 128; steps, network, recordings and the
policy that PPO begins from are the same. The gate is that of PPO: success probability of 0.95 for two frames
in a row, open loop, on rollouts of the filtered policy that no world model has learnt from."""


def section(load: Load) -> str:
    """Return the section: pictures and gate by quantizer, PPO in both, and the goal frame as judge."""
    cells = [cell for each in groups(load, STUDY, ()).values() for cell in each]
    fsq, lfq = ("/".join(percent(cells, method, domain) for domain in SCENES) for method in list(TITLES)[1:])
    return f"""LFQ codes serve as well: after PPO in their world model {lfq} % of known/unseen starts succeed,
with FSQ codes {fsq} % ({named_seeds(cells)}). The goal frame tells success less well than the classifier (AUC
in the last table), and at 5 % false positives it recognises few of the successes.

{quantizers(cells)}

{LIMITS}

{tables(load, STUDY, TITLES, "filtered")}

Success decided by the success classifier, or by the similarity to the goal frame (FSQ codes; one text world
model). Each has the lowest threshold that lets at most 5 % of the failures among the {cells[0]["rollouts"]}
rollouts pass from which both world models have learnt:

{goals(cells)}"""


def time_limit(load: Load) -> str:
    """Return the section: success within 40 and within 80 steps, and what PPO changes within 80."""
    later = [cell for each in groups(load, TIME_LIMIT, ()).values() for cell in each]
    seeds = {cell["seed"] for cell in later}
    first = [cell for each in groups(load, STUDY, ()).values() for cell in each if cell["seed"] in seeds]
    titles = {"filtered": "filtered BC", "ppo_fsq": "PPO in imagination"}
    rows = [
        [title, *(shares(cells, method, domain) for domain in SCENES for cells in (first, later))]
        for method, title in titles.items()
    ]
    columns = [f"{DOMAINS[domain]} scenes, {steps} steps" for domain in SCENES for steps in (40, 80)]
    before, after = ("/".join(percent(later, method, domain) for domain in SCENES) for method in titles)
    return f"""It does not: with twice as many steps filtered BC succeeds in {before} % of known/unseen
starts, and PPO from it in {after} % ({named_seeds(later)}). The policies are those of [codes](#codes),
trained for episodes of 40 steps. Distillation was not tried with 80.

{table(["method", *columns], rows)}

Within 80 steps. {changes(later, titles, "filtered")}"""


def named_seeds(cells: Sequence[Cell]) -> str:
    """Return `seeds 0, 100000`."""
    return f"seeds {', '.join(str(cell['seed']) for cell in cells)}" if len(cells) > 1 else "one seed"


def percent(cells: Sequence[Cell], method: str, domain: str) -> str:
    """Return the success of a method in per cent, the mean over seeds."""
    return f"{100 * mean(cells, method, domain):.0f}"


def quantizers(cells: Sequence[Cell]) -> str:
    """Return a table with a line for each seed, kind of scenes and quantizer."""
    rows = [
        [
            cell["seed"],
            DOMAINS[domain],
            title,
            used(gate["tokenizer"]),
            estimate(gate["headline"]["psnr_ceiling"]),
            estimate(gate["headline"]["delta_psnr_0_6s"]),
            *told(gate),
        ]
        for cell in cells
        for domain in SCENES
        for kind, title in QUANTIZERS.items()
        for gate in [cell["gates"][kind][domain]]
    ]
    columns = [
        "seed",
        "scenes",
        "codes",
        "codes used",
        "tokenizer's PSNR (dB)",
        "delta-PSNR after 0.6 s (dB)",
        "false positives",
        "recall",
        "AUC",
    ]
    return table(columns, rows)


def used(tokenizer: Mapping[str, Any]) -> str:
    """`82 % (perplexity 2,473)`: how many of its codes a tokenizer uses, and how evenly."""
    codes = tokenizer["codes"]
    return f"{100 * codes['used']:.0f} % (perplexity {codes['perplexity']:,.0f})"


def goals(cells: Sequence[Cell]) -> str:
    """Return a table with a line for each seed, kind of scenes and measure of success."""
    rows = [
        [cell["seed"], place, title, *told(cell["goal_distance"][measure][name])]
        for cell in cells
        for name, place in {CHOSEN: "known, learnt from", "ind": "known", "ood": "unseen"}.items()
        for measure, title in MEASURES.items()
    ]
    return table(["seed", "scenes", "decided by", "false positives", "recall", "AUC"], rows)


def told(gate: Mapping[str, Any]) -> list[str]:
    """Return false positives, recall and AUC, in short."""
    return [counted(gate["false_positive_rate"]), counted(gate["recall"]), f"{gate['auc']:.2f}"]
