"""A study with a budget: its ledger is made first, and no step learns from an episode that is not there."""

import json
import shutil
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from experiments.budget import Source, simple_commands, sources
from experiments.run import StudyError, run_study
from experiments.study import Step, Study, read_cells
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.ledger import Ledger, Limits

HEAD = """
question: Is it fair?
budget: {demonstrations: $demonstrations, rollouts: 20}
variables: {demonstrations: 6, data: nowhere}
steps:
"""


def study(folder: Path, *commands: str, given: tuple[str, ...] = (), head: str = HEAD) -> Study:
    """One step for each command."""
    path = folder / "fair.yaml"
    steps = [{"name": f"step_{number}", "command": command} for number, command in enumerate(commands)]
    path.write_text(head + "\n".join(f"  - {json.dumps(step)}" for step in steps))
    (study,) = read_cells(path, [f"output_dir={folder / 'out'}", *given])
    return study


def finished(study: Study) -> list[str]:
    return sorted(path.stem for path in (study.folder / "steps").glob("*.json"))


def test_the_ledger_is_there_before_the_first_step(tmp_path: Path) -> None:
    """It keeps what was charged when the study goes on, and its limits are the study's."""
    fair = study(tmp_path, "cp $budget $output_dir/seen.json")
    run_study(fair)
    seen = json.loads((tmp_path / "out" / "seen.json").read_text())
    assert seen["limits"] == {"demonstrations": 6, "rollouts": 20, "play": 0}
    Ledger(fair.budget).charge_training(tmp_path / "rl", 3)
    run_study(fair)
    assert Ledger(fair.budget).read().trainings == {"../rl": 3}
    with pytest.raises(StudyError, match="has other limits"):
        run_study(study(tmp_path, "true", given=("demonstrations=7",)))


def test_a_dataset_that_the_ledger_does_not_know_stops_the_study(
    tmp_path: Path, small_dataset: LeRobotDataset
) -> None:
    """With the flag of any command."""
    given = (f"data={small_dataset.root}",)
    for flags in (
        "--dataset.root=$data",
        "--dataset.more=[$data]",
        "--gate.dataset.root=$data",
    ):
        fair = study(tmp_path, "true", f"true && true {flags}", given=given)
        with pytest.raises(StudyError, match=r"step_1: --[a-z.]+=.*: 6 of 6 episodes are not in the budget"):
            run_study(fair)
        assert finished(fair) == ["step_0"]
    Ledger(fair.budget).charge(read_episodes(small_dataset))
    run_study(fair)


def test_of_chosen_episodes_only_these_are_looked_up(tmp_path: Path, small_dataset: LeRobotDataset) -> None:
    """What the shell chooses may be any of them."""
    chosen = "true --dataset.root=$data --dataset.episodes="
    commands = (f"{chosen}[0,4]", f"{chosen}[$$(echo 0)]")
    fair = study(tmp_path, *commands, given=(f"data={small_dataset.root}",))
    ledger = Ledger.create(fair.budget, Limits(demonstrations=6, rollouts=20))
    ledger.charge(read_episodes(small_dataset))
    content = json.loads(ledger.path.read_text())
    del content["episodes"][list(content["episodes"])[5]]
    ledger.path.write_text(json.dumps(content))
    with pytest.raises(StudyError, match=r"step_1: .*1 of 6 episodes are not in the budget"):
        run_study(fair)
    assert finished(fair) == ["step_0"]


def test_a_dataset_that_the_step_itself_makes_is_looked_up_afterwards(
    tmp_path: Path, small_dataset: LeRobotDataset
) -> None:
    fair = study(
        tmp_path,
        "cp -r $data $output_dir/new && true --dataset.root=$output_dir/new",
        given=(f"data={small_dataset.root}",),
    )
    with pytest.raises(StudyError, match=r"step_0: --dataset\.root=.*new: 6 of 6 episodes"):
        run_study(fair)
    assert finished(fair) == []
    shutil.rmtree(tmp_path / "out" / "new")
    Ledger(fair.budget).charge(read_episodes(small_dataset))
    run_study(fair)
    assert finished(fair) == ["step_0"]


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("lerobot-wmrl-record --output_dir=x", "step_1: lerobot-wmrl-record needs --budget="),
        ("a=1 lerobot-wmrl-train-world-model --steps=$$(echo 1 --budget=$budget)", "train-world-model needs"),
        ("torchrun -m lerobot_wmrl.scripts.train --budget=other.json", "scripts.train needs --budget="),
        ("true --budget=$budget; lerobot-wmrl-train --seed=1", "lerobot-wmrl-train needs --budget="),
        ("(lerobot-wmrl-train --seed=1) && true", "lerobot-wmrl-train needs --budget="),
        ("lerobot-train --dataset.root made", "--dataset.root needs an equals sign"),
        ("lerobot-train --dataset.root=$$folder", "only the shell knows this dataset"),
        ("lerobot-train --dataset.more=[a,$$(cat b)]", "only the shell knows this dataset"),
    ],
)
def test_a_command_that_cannot_be_kept_within_the_budget_is_named_at_once(
    command: str, message: str, tmp_path: Path
) -> None:
    fair = study(tmp_path, "true", command)
    with pytest.raises(StudyError, match=message):
        run_study(fair)
    assert not fair.folder.exists()


def test_commands_with_the_ledger_pass(tmp_path: Path) -> None:
    """None is run: the first step fails."""
    commands = [
        "false && lerobot-wmrl-record --seed=$$(echo 0) --budget=$budget",
        "lerobot-eval --seed=1000000",
        "env A=1 lerobot-wmrl-train --budget=$budget --env.dataset.root=$output_dir/x > log",
    ]
    with pytest.raises(StudyError, match="step_0: exit status 1"):
        run_study(study(tmp_path, *commands))


def test_wrong_limits_are_named(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match="budget: rollout: there are demonstrations, rollouts and play"):
        run_study(
            study(
                tmp_path, "true", head=HEAD.replace("{demonstrations: $demonstrations, rollouts", "{rollout")
            )
        )
    with pytest.raises(ValueError, match="budget: demonstrations must be a number of episodes, not many"):
        study(tmp_path, "true", given=("demonstrations=many",))


def test_every_command_of_a_line_is_read() -> None:
    line = "n=$(seq 0 3) && a --kinds='{x: (1; y)}' --steps=$((3 * (1 + 2))) --seed=0 | b > c; (d --e=f) && g"
    assert [words[0] for words in simple_commands(line)] == ["n=$inserted", "a", "b", "c", "d", "g"]
    assert [len(words) for words in simple_commands(line)] == [1, 4, 1, 1, 2, 1]
    step = Step(
        "s", "a --dataset.root=d --dataset.episodes=[0,2] --env.dataset.root=e --dataset.more='[f, g]'"
    )
    assert [*sources(step)] == [
        Source("dataset.root", "d", (0, 2)),
        Source("env.dataset.root", "e", None),
        Source("dataset.more", "f", None),
        Source("dataset.more", "g", None),
    ]
