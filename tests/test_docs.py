"""README and docs: their commands are today's, their Python runs, their links and figures are right."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from experiments.tables import loader
from experiments.value_cells import (
    BASELINES,
    IMAGINED,
    SECOND_PARTS,
    SECOND_STUDY,
    best,
    gains,
    groups,
    outcomes,
)
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.statistics import RunsMean
from lerobot_wmrl.common.stored_help import FOLDER
from lerobot_wmrl.improve.progress import CLONED, DISTILLED, PPO, SFT
from tests.experiments.typed import ROOT, check

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
WRITTEN = [page for page in PAGES if page.name != "results.md"]
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


def best_success(cells: Sequence[dict[str, Any]], methods: Sequence[str], domain: str) -> int:
    """Percent of the best method, the mean over seeds."""
    method = best(cells, methods, domain)
    return round(100 * RunsMean.over(outcomes(cells, method, domain)).mean)


def known_and_unseen(cells: Sequence[dict[str, Any]], methods: Sequence[str]) -> str:
    """Success as the README shows it; a dash where it was not measured with every seed."""
    if not any(all(method in cell["methods"] for cell in cells) for method in methods):
        return "–"
    return "/".join(str(best_success(cells, methods, domain)) for domain in ("ind", "ood"))


def in_points(cells: Sequence[dict[str, Any]], method: str, baseline: str) -> str:
    """What a method gains in known scenes, seed by seed."""
    found = gains(cells, method, baseline, "ind")
    return ", ".join(f"{round(100 * each)}".replace("-", "−") for each in found)


def test_the_readme_says_what_is_chance() -> None:
    """Gains over the best baseline: by Student's t over the seeds, and of PPO alone."""
    text, (first, *others) = (ROOT / "README.md").read_text(), groups(loader(ROOT / "docs")).values()
    means, ends, alone = [], [], []
    for domain in ("ind", "ood"):
        over = gains(first, "ppo_distilled", best(first, BASELINES, domain), domain)
        interval = ttest_1samp(over, 0).confidence_interval()
        means.append(f"{100 * np.mean(over):.0f}")
        ends.append(f"{100 * interval.low:.0f} to {100 * interval.high:.0f}".replace("-", "−"))
        ppo = gains(first, "imagined_ppo", best(first, BASELINES, domain), domain)
        alone.append(f"{100 * np.mean(ppo):.0f}")
        assert ttest_1samp(ppo, 0).pvalue > 0.05
    assert f"distilled +{'/+'.join(means)} ({'/'.join(ends)})" in text
    assert f"PPO +{'/+'.join(alone)}, within chance" in text
    best_gains, ppo_gains = [], []
    for cells in others:
        for domain in ("ind", "ood"):
            baseline = best(cells, BASELINES, domain)
            over = gains(cells, best(cells, IMAGINED, domain), baseline, domain)
            assert ttest_1samp(over, 0).pvalue > 0.05
            best_gains.append(round(100 * np.mean(over)))
            ppo_gains.append(round(100 * np.mean(gains(cells, "imagined_ppo", baseline, domain))))
    assert f"Our best methods gain {min(best_gains)} to {max(best_gains)}, within chance" in text
    assert f"PPO alone gains {max(0, min(ppo_gains))} to {max(ppo_gains)}." in text


def test_the_readme_compares_on_the_same_recordings() -> None:
    text = (ROOT / "README.md").read_text()
    cells = [json.loads(path.read_text()) for path in (ROOT / "docs/results/value_rewards").glob("*.json")]
    assert len(cells) == 3
    for method, words in (
        ("longer_filtered", "longer BC {rates}, PPO"),
        ("success", "PPO {rates} (+{gained}: Student's t over seeds, uncorrected)"),
        ("distilled", "distilled {rates} (+{gained})."),
    ):
        shares = ([cell["methods"][method][domain]["share"] for cell in cells] for domain in ("ind", "ood"))
        over = (
            ttest_1samp(gains(cells, method, "longer_filtered", domain), 0).confidence_interval()
            for domain in ("ind", "ood")
        )
        rates = "/".join(f"{100 * np.mean(each):.0f}" for each in shares)
        gained = "/+".join(f"{100 * low:.0f} to {100 * high:.0f}" for low, high in over)
        assert words.format(rates=rates, gained=gained) in text
    cells.sort(key=lambda cell: cell["seed"])
    over = [
        [f"{100 * each:.0f}" for each in gains(cells, "distilled", "longer_filtered", domain)]
        for domain in ("ind", "ood")
    ]
    known, unseen = (f"{', '.join(each[:-1])} and {each[-1]}" for each in over)
    said = f"by seed {known} points more than BC in known scenes, {unseen} in unseen ones"
    assert said in (ROOT / "docs" / "objections.md").read_text()
    for said, demonstrations, rival in (
        (
            "25 ({seeds}): best BC {filtered}, PPO {imagined_ppo}, distilled {ppo_distilled}; 50",
            25,
            "filtered",
        ),
        ("50 ({seeds}): {cloning}, {imagined_ppo}, {ppo_distilled}.", 50, "cloning"),
    ):
        more = [
            json.loads(path.read_text())["methods"]
            for path in (ROOT / "docs/results/value_same_recordings").glob(f"*s{demonstrations}_*.json")
        ]
        seeds = {1: "one seed", 2: "two seeds", 3: "three seeds"}[len(more)]
        rates = {
            method: "/".join(
                f"{100 * np.mean([cell[method][domain]['share'] for cell in more]):.0f}"
                for domain in ("ind", "ood")
            )
            for method in more[0]
        }
        assert said.format(seeds=seeds, **rates) in text
        baselines = {
            name: sum(cell[name][domain]["k"] for cell in more for domain in ("ind", "ood"))
            for name in more[0]
            if name in BASELINES
        }
        assert max(baselines, key=baselines.__getitem__) == rival
    (simulated,) = (ROOT / "docs/results/value_four_tasks_simulator").glob("*.json")
    for path, method, words in (
        (simulated, "simulated_ppo", "and {} after PPO in ManiSkill"),
        (ROOT / "docs/results/value_four_tasks" / simulated.name, "imagined_ppo", "The first seed has {},"),
    ):
        tasks = json.loads(path.read_text())["tasks"].values()
        shares = ([task[domain][method]["share"] for task in tasks] for domain in ("ind", "ood"))
        assert words.format("/".join(f"{100 * np.mean(each):.0f}" for each in shares)) in text


def test_the_readme_says_what_was_measured() -> None:
    text, results = (ROOT / "README.md").read_text(), ROOT / "docs" / "results"
    budgets = groups(loader(ROOT / "docs"))
    rows = {
        "BC of the demonstrations": ("cloning",),
        "best baseline": BASELINES,
        "PPO in imagination": ("imagined_ppo",),
        "PPO, then planning": ("planned",),
        "PPO, then the planner distilled": ("ppo_distilled",),
    }
    for title, methods in rows.items():
        shown = " | ".join(known_and_unseen(cells, methods) for cells in budgets.values())
        assert f"| {title} | {shown} |" in text
    places = json.loads((results / "demo.json").read_text())["runs"][0]["places"]
    known, unseen = (places[where]["policies"] for where in ("in known scenes", "in unseen scenes"))
    said = {SFT: " % before", CLONED: " after further BC", PPO: " after PPO", DISTILLED: " after a planner"}
    for policy, words in said.items():
        shares = (round(100 * rates[policy]["share"]) for rates in (known, unseen))
        assert f"{'/'.join(map(str, shares))}{words}" in text
    for study, method, words in (
        ("value_four_tasks", "longer", "longer BC"),
        ("value_four_tasks", "imagined_ppo", "PPO in imagination"),
        ("value_four_tasks_simulator", "simulated_ppo", "PPO in ManiSkill"),
    ):
        cells = [json.loads(path.read_text()) for path in (results / study).glob("*.json")]
        tasks = [task for cell in cells for task in cell["tasks"].values()]
        shares = ([task[domain][method]["share"] for task in tasks] for domain in ("ind", "ood"))
        assert f"{'/'.join(f'{100 * np.mean(each):.0f}' for each in shares)} after {words}" in text
    longer = [json.loads(path.read_text()) for path in (results / "value_longer").glob("*.json")]
    for demonstrations in {cell["demonstrations"] for cell in longer}:
        found = [
            cell["methods"]["longer_filtered"] for cell in longer if cell["demonstrations"] == demonstrations
        ]
        shares = ([each[domain]["share"] for each in found] for domain in ("ind", "ood"))
        assert f"{'/'.join(f'{100 * np.mean(each):.0f}' for each in shares)} with {demonstrations}" in text
    (pick_place,) = groups(loader(ROOT / "docs"), SECOND_STUDY, SECOND_PARTS).values()
    before, after = (
        "/".join(str(best_success(pick_place, (method,), domain)) for domain in ("ind", "ood"))
        for method in ("longer_filtered", "longer_discounted_ppo")
    )
    by_seed = in_points(pick_place, "longer_discounted_ppo", "longer_filtered")
    assert f"longer BC has {before}, PPO from it {after} (three seeds: {by_seed} points in known" in text
    assert f"with another discount {in_points(pick_place, 'longer_imagined_ppo', 'longer_filtered')})" in text
    assert len(pick_place) == 3
    rounds = {
        method: "/".join(str(best_success(pick_place, (method,), domain)) for domain in ("ind", "ood"))
        for method in ("iterated", "iterated_ppo")
    }
    in_rounds = in_points(pick_place, "iterated_ppo", "iterated").replace(", 22", " and 22")
    objections = (ROOT / "docs" / "objections.md").read_text()
    said_of_rounds = (
        f"BC has {rounds['iterated']} and PPO from it {rounds['iterated_ppo']}: by seed {in_rounds}"
    )
    assert said_of_rounds in objections
    assert best(pick_place, BASELINES, "ind") == "longer_filtered"
    over_seeds = ttest_1samp(gains(pick_place, "longer_discounted_ppo", "longer_filtered", "ind"), 0)
    assert over_seeds.pvalue > 0.05, "not significant over seeds"
    driven = [json.loads(path.read_text()) for path in (results / "driven").glob("*.json")]
    optimal = [cell["methods"]["optimal_cloning"] for cell in driven]
    shares = ([each[domain]["share"] for each in optimal] for domain in ("ind", "ood"))
    assert f"[{'/'.join(f'{100 * np.mean(each):.0f}' for each in shares)}](docs/results.md#driven)" in text
    words = {
        ("world_model_gate_anchored", "known"): "{} % of failures in known",
        ("world_model_gate_anchored", "unseen"): "{} % in unseen scenes",
    }
    for (stem, domain), phrase in words.items():
        gate = json.loads((results / f"{stem}.json").read_text())[domain]
        assert phrase.format(round(100 * gate["false_positive_rate"]["share"])) in text


@pytest.mark.parametrize("page", sorted(FOLDER.glob("*.txt")), ids=lambda page: page.stem)
def test_the_reference_is_what_help_says(page: Path) -> None:
    """Where it is not, `make help docs` writes it anew."""
    assert page.read_text().rstrip() in (ROOT / "docs" / "reference" / f"{page.stem}.md").read_text()
