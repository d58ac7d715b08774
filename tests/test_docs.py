"""README and docs: their commands are today's, their Python runs, their links and figures are right."""

import json
import re
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from experiments.page.value_cells import (
    BASELINES,
    SCENES,
    SECOND_PARTS,
    SECOND_STUDY,
    Cell,
    best,
    gains,
    groups,
)
from experiments.tables import loader
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.stored_help import FOLDER
from lerobot_wmrl.improve.progress import CLONED, DISTILLED, PPO, SFT
from tests.experiments.typed import ROOT, check

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
WRITTEN = [page for page in PAGES if page.name != "results.md"]
RESULTS: Final = ROOT / "docs" / "results"
BC: Final = ("cloning", "longer", "filtered", "longer_filtered")
NAMES = [str(page.relative_to(ROOT)) for page in WRITTEN]


def blocks(page: Path, language: str) -> list[str]:
    """Return the fenced blocks of a page in this language; "" is what a user types into a shell."""
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)
    return [text for found, text in fenced if found == language]


def commands(page: Path) -> list[str]:
    lines = [line.partition("  #")[0] for block in blocks(page, "") for line in block.splitlines()]
    inline = re.findall(r"`((?:python|lerobot-[a-z-]+) [^`…]*=[^`…]*)`", page.read_text())
    return [line for line in [*lines, *inline] if line.strip() and not re.search(r"=[A-Z]{2}", line)]


@pytest.mark.parametrize("name", NAMES)
def test_todays_commands_take_the_flags_of_the_page(name: str) -> None:
    for command in commands(ROOT / name):
        check(command)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("README.md", r"torch.Size\(\[16, 3, 32, 32\]\) tensor\(\["),
        ("docs/world_models.md", r"(True|False) .* of 2.* of 4"),
        ("docs/protocol.md", ""),
    ],
)
def test_the_python_of_a_page_runs(
    name: str,
    said: str,
    trained_models: dict[str, Path],
    small_dataset: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for place, made in (
        ("outputs/demo/improve/world_model", trained_models["action_world_model"]),
        ("outputs/demo/text_world_model", trained_models["text_world_model"]),
        ("outputs/demo/improve/merged", small_dataset.root),
        ("outputs/world_model", trained_models["action_world_model"]),
        ("data/demonstrations", small_dataset.root),
        ("data/rollouts", small_dataset.root),
    ):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).symlink_to(made)
    budget = tmp_path / "outputs" / "fair" / "budget.json"
    write_json(budget, {"limits": {"demonstrations": 8, "rollouts": 300, "play": 0}})
    monkeypatch.chdir(tmp_path)
    (code,) = blocks(ROOT / name, "python")
    exec(code, {})
    assert re.search(said, capsys.readouterr().out)


@pytest.mark.parametrize("name", [str(page.relative_to(ROOT)) for page in PAGES])
def test_links_lead_somewhere(name: str) -> None:
    page = ROOT / name
    for target in re.findall(r"\]\(([^)#]*)(#[^)]*)?\)", page.read_text()):
        path, anchor = target
        if path.startswith("http"):
            continue
        linked = page.parent / path if path else page
        assert linked.exists(), f"{name}: {path}"
        if anchor and linked.suffix == ".md":
            text = linked.read_text()
            titles = re.findall(r"^#+ (.*?)(?:<a|$)", text, re.MULTILINE)
            anchors = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}
            anchors |= set(re.findall(r'<a id="(.*?)">', text))
            assert anchor[1:] in anchors, f"{name}: {path}{anchor}"


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().split()) < 1000


def in_percent(*shares: float) -> str:
    return "/".join(f"{100 * share:.0f}" for share in shares)


def read_all(study: str) -> list[Cell]:
    """The published cells of a study, in order of their seeds."""
    cells = [json.loads(path.read_text()) for path in (RESULTS / study).glob("*.json")]
    return sorted(cells, key=lambda cell: cell["seed"])


def mean_success(cells: Sequence[Cell], method: str) -> str:
    """Known/unseen success as the README shows it, the mean over seeds."""
    shares = ([cell["methods"][method][domain]["share"] for cell in cells] for domain in SCENES)
    return in_percent(*map(np.mean, shares))


def mean_over_tasks(cells: Sequence[Cell], method: str) -> str:
    """The same of cells that have several tasks."""
    tasks = [task for cell in cells for task in cell["tasks"].values()]
    return in_percent(*(np.mean([task[domain][method]["share"] for task in tasks]) for domain in SCENES))


def best_bc(cells: Sequence[Cell]) -> str:
    """The method of BC with the most successes, chosen where it is reported; it was run with every seed."""
    names = [name for name in BC if all(name in cell["methods"] for cell in cells)]
    return max(names, key=lambda name: sum(cell["methods"][name][d]["k"] for cell in cells for d in SCENES))


def seed_interval(cells: Sequence[Cell], method: str, baseline: str, domain: str) -> tuple[float, float]:
    """95 % interval of what a method gains, by Student's t over the seeds."""
    interval = ttest_1samp(gains(cells, method, baseline, domain), 0).confidence_interval()
    return interval.low, interval.high


def in_words(low: float, high: float) -> str:
    return f"{100 * low:.0f} to {100 * high:.0f}"


def in_points(cells: Sequence[Cell], method: str, baseline: str) -> str:
    """What a method gains in known scenes, seed by seed."""
    found = gains(cells, method, baseline, "ind")
    return ", ".join(f"{round(100 * each)}".replace("-", "−") for each in found)


def push_rows() -> dict[str, tuple[list[Cell], tuple[str, str, str]]]:
    """README's rows of push with the policy cnn: cells, and BC, PPO and the distilled planner in them."""
    (more,) = (cells for budget, cells in groups(loader(ROOT / "docs")).items() if budget == (25, 1000))
    rows = {
        "[8 + 300](docs/results.md#value_rewards)": (read_all("value_rewards"), ("success", "distilled")),
        "[25 + 1,000](docs/results.md#value_push)": (more, ("imagined_ppo", "ppo_distilled")),
    }
    for demonstrations in (25, 50):
        cells = [
            cell
            for cell in read_all("value_same_recordings")
            if (cell["demonstrations"], cell["rollouts"]) == (demonstrations, 300)
        ]
        title = f"[{demonstrations} + 300](docs/results.md#value_same_recordings)"
        rows[title] = cells, ("imagined_ppo", "ppo_distilled")
    return {title: (cells, (best_bc(cells), *methods)) for title, (cells, methods) in rows.items()}


def test_the_readme_s_table_says_what_was_measured() -> None:
    text, simulated = (ROOT / "README.md").read_text(), groups(loader(ROOT / "docs"))
    for title, (cells, (bc, *imagined)) in push_rows().items():
        budget = cells[0]["demonstrations"], cells[0]["rollouts"]
        assert len(simulated[budget]) == 3
        shown = [mean_success(cells, bc), mean_success(simulated[budget], "simulated_ppo")]
        shown += [mean_success(cells, method) for method in imagined]
        assert f"| {title} | {len(cells)} | {' | '.join(shown)} |" in text
    pull = [cell for cell in read_all("value_tasks") if cell["task"] == "pull"]
    shown = [mean_success(pull, name) for name in (best_bc(pull), "imagined_ppo", "ppo_distilled")]
    assert f"| [pull](docs/results.md#value_tasks), `cnn` | 8 + 300 | {len(pull)} | {shown[0]} | – |" in text
    assert f"| {len(pull)} | {shown[0]} | – | {shown[1]} | {shown[2]} |" in text
    act = read_all("value_act")
    bc, ppo, distilled = (
        mean_success(act, name) for name in ("longer_filtered", "imagined_ppo", "distilled")
    )
    assert best_bc(act) == "longer_filtered"
    assert f"| {len(act)} | {bc} | – | {ppo} | {distilled} |" in text
    (pick_place,) = groups(loader(ROOT / "docs"), SECOND_STUDY, SECOND_PARTS).values()
    bc, ppo = (mean_success(pick_place, name) for name in ("longer_filtered", "longer_discounted_ppo"))
    (one,) = read_all("value_pick_place_simulator")
    assert best(pick_place, BASELINES, "ind") == "longer_filtered"
    assert f"| {len(pick_place)} | {bc} | {mean_success([one], 'simulated_ppo')} (one) | {ppo} | – |" in text
    tasks, (one,) = read_all("value_four_tasks"), read_all("value_four_tasks_simulator")
    bc, ppo = (mean_over_tasks(tasks, method) for method in ("longer", "imagined_ppo"))
    simulator = mean_over_tasks([one], "simulated_ppo")
    assert f"| {len(tasks)} | {bc} | {simulator} (one) | {ppo} | – |" in text
    assert one["seed"] == tasks[0]["seed"]
    assert f"(same seed: {mean_over_tasks(tasks[:1], 'imagined_ppo')} in imagination)" in text


def test_the_readme_says_what_is_chance() -> None:
    """Gains by Student's t over the seeds: over BC on the same recordings, and over PPO in ManiSkill."""
    text, rows = (ROOT / "README.md").read_text(), push_rows()
    cells, (bc, *methods) = rows["[25 + 300](docs/results.md#value_same_recordings)"]
    assert len(cells) == 3
    for method, domain in product(methods, SCENES):
        assert seed_interval(cells, method, bc, domain)[0] < 0
    cells, (bc, ppo, distilled) = rows["[8 + 300](docs/results.md#value_rewards)"]
    (known, unseen), others = (
        [in_words(*seed_interval(cells, method, bc, domain)) for domain in SCENES]
        for method in (ppo, distilled)
    )
    said = f"PPO gains {known} points in known and {unseen} in unseen scenes, distillation"
    assert f"{said} {' and '.join(others)}." in text
    for (demonstrations, _), found in groups(loader(ROOT / "docs")).items():
        for method in ("imagined_ppo", "ppo_distilled") if demonstrations > 8 else ():
            for domain in SCENES:
                gain = ttest_1samp(gains(found, method, "simulated_ppo", domain), 0)
                assert gain.pvalue > 0.05, "over PPO in ManiSkill"
    (pick_place,) = groups(loader(ROOT / "docs"), SECOND_STUDY, SECOND_PARTS).values()
    over_seeds = ttest_1samp(gains(pick_place, "longer_discounted_ppo", "longer_filtered", "ind"), 0)
    assert over_seeds.pvalue > 0.05, "not significant over seeds"
    assert "With 25 + 300, and in pick and place, three seeds prove none." in text


def test_the_readme_says_what_else_was_measured() -> None:
    text = (ROOT / "README.md").read_text()
    places = json.loads((RESULTS / "demo.json").read_text())["runs"][0]["places"]
    known, unseen = (places[where]["policies"] for where in ("in known scenes", "in unseen scenes"))
    said = {SFT: " % before", CLONED: " after further BC", PPO: " after PPO", DISTILLED: " after a planner"}
    for policy, words in said.items():
        assert f"{in_percent(*(rates[policy]['share'] for rates in (known, unseen)))}{words}" in text
    assert f"[{mean_success(read_all('driven'), 'optimal_cloning')}](docs/results.md#driven)" in text
    gate = json.loads((RESULTS / "world_model_gate_anchored.json").read_text())
    known, unseen = (
        in_percent(gate[scenes]["false_positive_rate"]["share"]) for scenes in ("known", "unseen")
    )
    assert f"takes {known}/{unseen} % of failures for successes" in text


def test_the_objections_say_what_was_measured() -> None:
    text, cells = (ROOT / "docs" / "objections.md").read_text(), read_all("value_rewards")
    over = [
        [in_percent(each) for each in gains(cells, "distilled", "longer_filtered", domain)]
        for domain in SCENES
    ]
    known, unseen = (f"{', '.join(each[:-1])} and {each[-1]}" for each in over)
    assert f"by seed {known} points more than BC in known scenes, {unseen} in unseen ones" in text
    without = read_all("value_without_noise")
    calm, longer_calm = (mean_success(without, method) for method in ("noiseless", "longer_noiseless"))
    first = [cell for cell in cells if cell["seed"] in {each["seed"] for each in without}]
    noisy, longer = (mean_success(first, method) for method in ("filtered", "longer_filtered"))
    assert (
        f"Filtered BC has {calm} in place of {noisy}, with 9,000 steps {longer_calm} in place of {longer} "
        in text
    )
    (pick_place,) = groups(loader(ROOT / "docs"), SECOND_STUDY, SECOND_PARTS).values()
    for method, said in (
        ("longer_discounted_ppo", "by seed {} points more in known scenes, 1, 7"),
        ("longer_imagined_ppo", "from the same longer BC, by {} points"),
    ):
        by_seed = " and ".join(in_points(pick_place, method, "longer_filtered").rsplit(", ", 1))
        assert said.format(by_seed) in text
    bc, ppo = (mean_success(pick_place, method) for method in ("iterated", "iterated_ppo"))
    in_rounds = in_points(pick_place, "iterated_ppo", "iterated").replace(", 22", " and 22")
    assert f"BC has {bc} and PPO from it {ppo}: by seed {in_rounds}" in text


@pytest.mark.parametrize("page", sorted(FOLDER.glob("*.txt")), ids=lambda page: page.stem)
def test_the_reference_is_what_help_says(page: Path) -> None:
    """Where it is not, `make help docs` writes it anew."""
    assert page.read_text().rstrip() in (ROOT / "docs" / "reference" / f"{page.stem}.md").read_text()
