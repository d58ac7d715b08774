"""What is decided for data that does not exist, and the commands that come of it."""

from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import draccus
import numpy as np
import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig, PushtEnv
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
from lerobot.scripts.lerobot_edit_dataset import EditDatasetConfig

from lerobot_policy_cnn.configuration_cnn import CnnConfig
from lerobot_wmrl.common.checkpoints import link_checkpoint
from lerobot_wmrl.common.errors import STOPPED, FieldError
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.output_folders import Claim
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.common.presets import preset_settings
from lerobot_wmrl.common.stages import MARKER
from lerobot_wmrl.data.dataset import ChosenEpisodes, open_dataset
from lerobot_wmrl.data.embodiment import Embodiment, read_embodiment
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.improve import commands, learnt
from lerobot_wmrl.improve.findings import (
    few_decisions,
    inspect_dataset,
    one_sided_tasks,
    require_checkable,
    usual_length,
)
from lerobot_wmrl.improve.plan import Plan
from lerobot_wmrl.improve.progress import CLONED, DISTILLED, FITTED, PPO, SFT, Progress
from lerobot_wmrl.improve.report.words import reservations
from lerobot_wmrl.improve.stages import list_stages
from lerobot_wmrl.scripts.compare import CompareConfig
from lerobot_wmrl.scripts.improve import settings
from lerobot_wmrl.world_models.configuration_frame_tokenizer import TokenizerConfig
from lerobot_wmrl.world_models.configuration_world_model import AnchoredConfig
from tests.improve.made_up import commands_of, improvement_of, made_commands
from tests.relabelled import relabelled
from tests.rl.checkpoints import save_untrained_policy


def imagined_comparison(improvement: Progress, folder: Path) -> list[str]:
    """Return the command that compares the policies on 256 imagined starts."""
    return commands.compare_command(improvement, folder, commands.imagination(improvement), 256)


@pytest.mark.parametrize(
    ("longest", "clip", "length", "branches"),
    [(40, 42, 40, 0), (98, 100, 98, 0), (120, 100, 98, 1), (300, 100, 98, 3)],
)
def test_long_episodes_are_imagined_in_parts(
    longest: int, clip: int, length: int, branches: int, tmp_path: Path
) -> None:
    """From frames all over them, as many as it takes to cover them; so successes at their ends count."""
    made = made_commands(tmp_path, longest=longest, usual=longest)
    assert f"--model.clip_length={clip}" in made["world_model"]
    judged = [flag for flag in made["check"] if flag.startswith("--episode_length")]
    assert judged == ([] if branches else [f"--episode_length={length}"])
    for stage in ("rl", "comparison"):
        assert {f"--env.episode_length={length}", f"--env.dataset.branches={branches}"} <= {*made[stage]}


def test_one_long_recording_does_not_divide_all_the_others(tmp_path: Path) -> None:
    assert "--env.dataset.branches=3" in made_commands(tmp_path, longest=9000, usual=300)["rl"]


@pytest.mark.parametrize(("longest", "branches"), [(5, 3), (19, 0)])
def test_imagination_begins_all_over_the_rollouts_too(
    longest: int, branches: int, make_synthetic_dataset: Any, tmp_path: Path
) -> None:
    """Here they have 20 frames. A frame more than the dataset has is no reason to begin in the middle."""
    improvement = improvement_of(tmp_path, longest=longest, usual=longest, total=3)
    assert improvement.learnt.branches() == 0
    make_synthetic_dataset(tmp_path / "merged", episodes=6)
    improvement.plan.config.rollouts = 3
    assert improvement.learnt.branches() == branches


def test_no_start_is_imagined_twice_where_one_task_has_few(
    make_synthetic_dataset: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Imagination begins in some of the episodes of a large dataset, and in fewer still of each task."""
    root = make_synthetic_dataset(tmp_path / "merged", episodes=6).root
    tasks = read_episodes(open_dataset(root)).column("start.task")
    assert len(np.unique(tasks)) == 1
    monkeypatch.setattr(learnt, "MAX_STARTS", 4)
    improvement = improvement_of(tmp_path, total=6, fewest=6)
    improvement.plan.config.dataset = ChosenEpisodes(str(root))
    assert "--n_episodes=4" in commands.compare_command(
        improvement, tmp_path, commands.imagination(improvement), 256
    )
    table = read_episodes(open_dataset(root))
    two = replace(table, columns={**table.columns, "start.task": np.array([0, 0, 0, 0, 1, 1])})
    monkeypatch.setattr(type(improvement.learnt), "chosen", lambda self: two)
    assert "--n_episodes=1" in commands.compare_command(
        improvement, tmp_path, commands.imagination(improvement), 256
    )


def test_another_round_does_not_double_the_frames_of_a_rollout(tmp_path: Path) -> None:
    improvement = improvement_of(tmp_path, longest=80)
    improvement.plan.config.rollouts, improvement.plan.config.real_env = 3, PushtEnv()
    improvement.plan.config.selection_episodes = 0
    assert improvement.plan.frame_limit == 160
    improvement.plan.config.max_frames = 80
    assert improvement.plan.frame_limit == 80
    assert "--max_frames=80" in (commands.another_round_command(improvement) or [])


@pytest.mark.parametrize("size", ["tiny", "demo", "cpu"])
@pytest.mark.parametrize("side", [16, 48, 63, 80, 84, 96, 112, 480])
def test_frames_of_any_size_make_a_grid_that_the_transformer_divides(
    size: str, side: int, tmp_path: Path
) -> None:
    command = made_commands(tmp_path, size, frame_side=side)["tokenizer"]
    (given,) = (flag for flag in command if flag.startswith("--model.tokenizer.image_size="))
    preset = preset_settings(size, "train-world-model", ["frame_tokenizer"])
    sizes = {name.rpartition(".")[2]: value for name, value in preset.items() if "tokenizer." in name}
    tokenizer = TokenizerConfig(**{**sizes, "image_size": int(given.partition("=")[2])})
    dynamics = preset_settings(size, "train-world-model", ["action_world_model"])
    grid = tokenizer.image_size // tokenizer.downsample
    assert grid % int(dynamics.get("model.dynamics.patch", AnchoredConfig.patch)) == 0


@pytest.mark.parametrize(
    ("kind", "pixels", "flags"),
    [
        (CnnConfig, 2 * 64**2, set()),
        (CnnConfig, 480 * 640, {"--algorithm.micro_batch_size=27"}),
        (CnnConfig, 1080 * 1920, {"--num_envs=16", "--algorithm.micro_batch_size=4"}),
        (VQBeTConfig, 480 * 640, {"--num_envs=21", "--algorithm.recorded=false", "--algorithm.batch_size=5"}),
    ],
)
def test_large_frames_are_trained_on_in_smaller_numbers(
    kind: type[PreTrainedConfig], pixels: int, flags: set[str], tmp_path: Path
) -> None:
    """A policy acts on 2²⁵ pixels at once and learns from 2²³ in a pass; recorded labels are at most 2 GiB.

    VQ-BeT learns from five observations at once.
    """
    policy = kind(device="cpu", pretrained_path=tmp_path)
    command = made_commands(
        tmp_path, policy=policy, pixels=pixels, longest=98, usual=98, success_frames=3000
    )["rl"]
    limits = (
        "--num_envs=",
        "--algorithm.micro_batch_size=",
        "--algorithm.batch_size=",
        "--algorithm.recorded=",
    )
    assert {flag for flag in command if flag.startswith(limits)} == flags


@pytest.mark.parametrize(("stage", "flags"), [("rl", []), ("distilled", ["--num_envs=37"])])
def test_imagined_frames_of_a_training_are_2_gib_at_most(
    stage: str, flags: list[str], tmp_path: Path
) -> None:
    """Distillation keeps those of all six iterations, PPO those of one, as small as they are imagined."""
    cameras = {"cameras": ["top", "wrist"], "frame_side": 480, "pixels": 2 * 128**2}
    command = made_commands(tmp_path, "cpu", **cameras, longest=98, usual=98)[stage]
    assert [flag for flag in command if flag.startswith("--num_envs=")] == flags


@pytest.mark.parametrize(
    ("found", "taken"),
    [
        ({"total": 500, "fewest": 500, "tasks": 1}, 100),
        ({"total": 60, "fewest": 60, "tasks": 1}, 60),
        ({"total": 500, "fewest": 120, "tasks": 4}, 1024),
        ({"total": 500, "fewest": 500, "longest": 300}, 100),
    ],
)
def test_imagined_comparisons_begin_in_all_parts_of_a_dataset(
    found: dict[str, int], taken: int, tmp_path: Path
) -> None:
    """Not in neighbouring episodes, which may be of one task, or of demonstrations alone."""
    assert f"--env.dataset.max_starts={taken}" in made_commands(tmp_path, **found)["comparison"]


def test_successes_that_are_all_held_out_are_not_enough(make_synthetic_dataset: Any, tmp_path: Path) -> None:
    """Unless rollouts, which are recorded too, bring others."""
    root = Path(make_synthetic_dataset(tmp_path / "data", episodes=20).root)
    episode = np.asarray(read_episodes(open_dataset(root)).dataset.hf_dataset["episode_index"])
    relabelled(root, tmp_path / "last", {"next.success": (episode == 19).tolist()})
    table = read_episodes(open_dataset(tmp_path / "last"))
    policy = read_policy_config(str(save_untrained_policy(tmp_path / "policy", actions=7)), [])
    with pytest.raises(FieldError, match="its 1 successful episodes are all held out from training"):
        inspect_dataset(table, policy, None)
    assert inspect_dataset(table, policy, None, rollouts=9).total == 20


@pytest.mark.parametrize(("held_out", "split"), [(0, "all"), (9, "all"), (10, "validation")])
def test_the_check_takes_held_out_episodes_where_there_are_enough(
    tmp_path: Path, held_out: int, split: str
) -> None:
    assert f"--split={split}" in made_commands(tmp_path, held_out=held_out)["check"]


@pytest.mark.parametrize(("failures", "tell", "split"), [(19, False, "all"), (19, True, "validation")])
def test_the_check_takes_failures_wherever_they_are(
    tmp_path: Path, failures: int, tell: bool, split: str
) -> None:
    """Successes alone say nothing of false positives."""
    found = {"held_out": 10, "held_out_tell": tell, "failures": failures}
    assert improvement_of(tmp_path, **found).learnt.checked() == ({"dataset.root": "data"}, split)


def test_the_check_takes_the_episodes_that_are_given_for_it(tmp_path: Path) -> None:
    improvement = improvement_of(tmp_path, held_out=200, held_out_tell=True, failures=19)
    improvement.plan.config.check = ChosenEpisodes("kept", episodes=[1, 2])
    (command,) = commands_of(improvement, "check").values()
    assert {"--dataset.root=kept", "--dataset.episodes=[1,2]", "--split=all"} <= {*command}


def test_episodes_to_check_on_are_looked_at_before_anything_is_trained(
    make_synthetic_dataset: Any, small_dataset: Any, tmp_path: Path
) -> None:
    table = read_episodes(small_dataset)
    robot = read_embodiment(small_dataset.meta, Embodiment())
    cameras = ["observation.images.third_view"]
    require_checkable(table, None, table, robot, cameras)
    larger = read_episodes(make_synthetic_dataset(tmp_path / "larger", size=48))
    require_checkable(larger, None, table, robot, cameras)  # frames of any size are fitted to the tokenizer's
    with pytest.raises(FieldError, match=r"of its episodes 2 succeed and 0 fail, and a check needs both"):
        require_checkable(table, [0, 1], table, robot, cameras)
    with pytest.raises(FieldError, match="has 25 frames a second, the world model has learnt 30"):
        require_checkable(table, None, table, replace(robot, fps=30), cameras)
    other = read_episodes(make_synthetic_dataset(tmp_path / "other", cameras=("wrist",)))
    with pytest.raises(FieldError, match=r"the dataset has no observation\.images\.third_view"):
        require_checkable(other, None, table, robot, cameras)
    require_checkable(other, None, table, robot, ["observation.images.wrist"])


BOTH, EARLY, NEITHER = "both outcomes", "both, but held-out successes alone", "successes alone"

ALIKE = 11
"""Held-out episodes of a dataset that all succeed."""


@pytest.mark.parametrize(
    ("rollouts", "outcomes", "held_out", "root", "split"),
    [
        (9, BOTH, 2, "data", "all"),
        (10, BOTH, 2, "rollouts", "all"),
        (10, BOTH, 10, "data", "validation"),
        (200, BOTH, 10, "rollouts", "validation"),
        (200, EARLY, 2, "rollouts", "all"),
        (200, EARLY, 10, "data", "validation"),
        (200, NEITHER, 2, "data", "all"),
        (100, EARLY, ALIKE, "rollouts", "all"),
        (200, NEITHER, ALIKE, "data", "validation"),
    ],
)
def test_rollouts_are_checked_on_if_they_tell_more_than_the_dataset(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    rollouts: int,
    outcomes: str,
    held_out: int,
    root: str,
    split: str,
) -> None:
    number = np.arange(rollouts)
    success = {BOTH: (number + number // 20) % 2 == 0, EARLY: number > 9, NEITHER: number >= 0}[outcomes]
    table = SimpleNamespace(
        success=np.append(np.ones(40, bool), success),
        validation=np.append(np.ones(40, bool), number % 20 == 19),
    )
    monkeypatch.setattr(learnt, "read_episodes", lambda dataset: table)
    monkeypatch.setattr(ChosenEpisodes, "open", lambda self: self.root)
    improvement = improvement_of(tmp_path, held_out=held_out, held_out_tell=held_out == 10)
    improvement.plan.config.rollouts, improvement.plan.config.real_env = rollouts, PushtEnv()
    merged = {"dataset.root": str(tmp_path / "merged"), "dataset.episodes": [*range(40, 40 + rollouts)]}
    wanted = {"data": {"dataset.root": "data"}, "rollouts": merged}[root]
    assert improvement.learnt.checked() == (wanted, split)


@pytest.mark.parametrize("better", [None, "before"])
def test_rollouts_are_merged_and_successes_cloned_before_rl(
    better: str | None, make_synthetic_dataset: Any, tmp_path: Path
) -> None:
    """Two of four episodes are chosen, and two rollouts; RL begins with the cloned policy, unless the world
    model decides that the policy before is better."""
    folder = tmp_path / "improve"
    numbers = dict.fromkeys(("observation.state", "action", "effort"), "float32")
    improvement = improvement_of(
        folder, total=4, failures=2, columns={"observation.image": "video", **numbers}
    )
    config = improvement.plan.config
    config.rollouts, config.real_env, config.dataset.episodes = 2, PushtEnv(), [0, 3]
    before, cloned, ppo, distilled = improvement.policies.values()
    results = {
        "finished": True,
        "policies": {"a": {"share": 0.1}, "b": {"share": 0.9}},
        "pairs": [{"before": "a", "after": "b", "better": better and "b"}],
    }
    write_json(folder / "start" / "comparison.json", results)
    stages = iter(list_stages(improvement))
    made = {stage.name: stage.command() for stage in islice(stages, 3)}
    success = read_episodes(make_synthetic_dataset(folder / "merged", episodes=6)).success
    made |= {stage.name: stage.command() for stage in stages}
    assert {"--root=data", f"--new_root={folder / 'columns'}", "--operation.feature_names=[effort]"} <= {
        *made["columns"]
    }
    assert {f"--like.root={folder / 'columns'}", "--max_frames=80", "--video=true", "--seed=50000"} <= {
        *made["rollouts"]
    }
    assert f"--operation.roots=[{folder / 'columns'},{folder / 'rollouts'}]" in made["merged"]
    episodes = [episode for episode in (0, 3, 4, 5) if success[episode]]
    assert 0 < len(episodes) < 4
    assert {f"--policy.path={before}", f"--dataset.episodes={episodes}".replace(" ", "")} <= {*made["cloned"]}
    learnt = {f"--dataset.root={folder / 'merged'}", "--dataset.episodes=[0,3,4,5]"}
    assert learnt <= {*made["tokenizer"]}
    assert learnt <= {*made["world_model"]}
    starts = {flag.replace("--", "--env.", 1) for flag in learnt}
    assert {*starts, f"--policies=[{cloned},{before}]", "--n_episodes=4"} <= {*made["start"]}
    assert {*starts, f"--policy.path={before if better else cloned}"} <= {*made["rl"]}
    planner = {"--algorithm.type=distillation", "--algorithm.recorded=false", "--gate.action=off"}
    assert {*starts, *planner, f"--policy.path={ppo}"} <= {*made["distilled"]}
    everything = {f"--policies=[{before},{cloned},{ppo},{distilled}]", "--against=all", "--env.type=pusht"}
    assert {*everything, "--n_episodes=100", "--seed=1000000"} <= {*made["comparison"]}
    assert {*everything, "--n_episodes=50", "--seed=2000025"} <= {*made["choice"]}
    measured = {"--selection.freq=10", "--selection.n_episodes=25", "--real_env.type=pusht"}
    assert measured <= {*made["rl"]}
    assert "checkpoints/best/" in ppo
    assert "checkpoints/last/" in distilled


def test_lerobot_edits_the_dataset_in_a_folder_with_any_name(tmp_path: Path) -> None:
    """2024_01_15 is a number in YAML, by which LeRobot reads what is not quoted."""
    numbers = dict.fromkeys(("observation.state", "action", "effort"), "float32")
    improvement = improvement_of(tmp_path, root=Path("2024_01_15"), columns=numbers)
    improvement.plan.config.rollouts, improvement.plan.config.real_env = 20, PushtEnv()
    config = draccus.parse(EditDatasetConfig, args=commands.columns_command(improvement)[1:])
    assert (config.root, config.operation.feature_names) == ("2024_01_15", ["effort"])


@pytest.mark.parametrize(
    ("real", "rollouts", "longest", "discount"),
    [
        (None, 0, 40, 0.97),
        (WmrlManiSkillEnv(task="push"), 300, 37, 0.97),
        (PushtEnv(), 150, 150, 0.996),
        (PushtEnv(), 0, 150, 0.992),
        (None, 0, 5000, 0.999),
    ],
)
def test_the_discount_leaves_a_late_success_its_worth(
    real: EnvConfig | None, rollouts: int, longest: int, discount: float, tmp_path: Path
) -> None:
    improvement = improvement_of(tmp_path, longest=longest)
    improvement.plan.config.real_env, improvement.plan.config.rollouts = real, rollouts
    assert improvement.plan.discount == discount
    if not rollouts:
        rl = commands_of(improvement, "rl")["rl"]
        assert f"--algorithm.gamma={discount}" in rl


def test_commands_name_the_checkpoint_that_is_there_now_as_lerobots_take_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for step in ("000002", "000004"):
        save_untrained_policy(tmp_path / "cloned" / "checkpoints" / step / "pretrained_model")
    link_checkpoint(tmp_path / "cloned" / "checkpoints" / "000002", "last")
    for given in ("cloned", "cloned/checkpoints/last", "cloned/checkpoints/last/pretrained_model"):
        policy = CnnConfig(device="cpu", pretrained_path=Path(given))
        improvement = improvement_of(tmp_path, policy=policy)
        assert improvement.plan.policy == "cloned/checkpoints/000002/pretrained_model"
    link_checkpoint(tmp_path / "cloned" / "checkpoints" / "000004", "last")
    assert improvement.plan.policy == "cloned/checkpoints/000004/pretrained_model"


def test_policies_in_a_folder_with_a_comma_are_compared(tmp_path: Path) -> None:
    improvement = improvement_of(tmp_path / "push, a")
    improvement.plan.config.real_env = PushtEnv()
    (command,) = commands_of(improvement, "comparison").values()
    assert draccus.parse(CompareConfig, args=command[1:]).policies == [*improvement.policies.values()]


def test_without_starts_to_select_on_the_last_checkpoint_and_policy_are_taken(tmp_path: Path) -> None:
    improvement = improvement_of(tmp_path)
    improvement.plan.config.real_env, improvement.plan.config.selection_episodes = PushtEnv(), 0
    made = commands_of(improvement, "rl", "choice")
    assert [*made] == ["rl"]
    assert not [flag for flag in made["rl"] if "selection" in flag]
    assert "checkpoints/last/" in improvement.policies[PPO]
    assert improvement.chosen() == DISTILLED


@pytest.mark.parametrize(("real", "link"), [(None, "last"), (PushtEnv(), "best")])
def test_rl_may_stop_by_its_own_rules_if_it_leaves_a_checkpoint(
    real: PushtEnv | None, link: str, tmp_path: Path
) -> None:
    """After any other error it is tried again. No planner is fitted to this policy, which could go on."""
    improvement = improvement_of(tmp_path, policy=VQBeTConfig(device="cpu", pretrained_path=tmp_path))
    improvement.plan.config.real_env = real
    (rl,) = (stage for stage in list_stages(improvement) if stage.name == "rl")
    for other in {"last", "best"} - {link}:
        (tmp_path / "rl" / "checkpoints" / other / "pretrained_model").mkdir(parents=True)
    assert not rl.optional(STOPPED)
    (tmp_path / "rl" / "checkpoints" / link / "pretrained_model").mkdir(parents=True)
    assert rl.optional(STOPPED)
    assert not rl.optional(1)


def test_rl_that_gained_nothing_in_reality_is_not_compared_as_something_else(tmp_path: Path) -> None:
    """Its best checkpoint is the policy that it began with."""
    improvement = improvement_of(tmp_path, failures=10)
    improvement.plan.config.real_env = PushtEnv()
    for step in ("000000", "000010"):
        (tmp_path / "rl" / "checkpoints" / step / "pretrained_model").mkdir(parents=True)
    link_checkpoint(tmp_path / "rl" / "checkpoints" / "000010", "best")
    assert [*improvement.policies] == [SFT, CLONED, PPO, DISTILLED]
    assert not improvement.kept_start
    link_checkpoint(tmp_path / "rl" / "checkpoints" / "000000", "best")
    assert [*improvement.policies] == [SFT, CLONED, FITTED]
    assert any(said.startswith("RL gained nothing") for said in reservations(improvement))
    alone = improvement_of(tmp_path, policy=VQBeTConfig(device="cpu", pretrained_path=tmp_path))
    alone.plan.config.real_env = PushtEnv()
    assert [*alone.policies] == [SFT, FITTED], "there is no other to compare with"


def test_rl_that_left_nothing_leaves_the_policy_of_further_bc_to_the_planner(tmp_path: Path) -> None:
    """It may find what PPO's noise does not."""
    improvement = improvement_of(tmp_path, failures=10)
    assert [*improvement.policies] == [SFT, CLONED, PPO, DISTILLED]
    (rl,) = (stage for stage in list_stages(improvement) if stage.name == "rl")
    assert rl.optional(STOPPED)
    write_json(tmp_path / "stages" / "rl.json", {"failed": "stopped: no episode was rewarded"})
    results = {"finished": True, "policies": {"a": {"share": 0.0}, "b": {"share": 0.0}}, "pairs": []}
    write_json(tmp_path / "start" / "comparison.json", results)
    assert [*improvement.policies] == [SFT, CLONED, FITTED]
    (distilled,) = commands_of(improvement, "distilled").values()
    assert f"--policy.path={improvement.policies[CLONED]}" in distilled
    write_json(tmp_path / "stages" / "distilled.json", {"failed": "stopped: no success"})
    assert [*improvement.policies] == [SFT, CLONED]
    assert improvement.chosen() == CLONED


def test_rl_that_left_nothing_leaves_a_policy_of_successes_to_the_planner(tmp_path: Path) -> None:
    """If the planner finds nothing either, there is nothing to compare."""
    improvement = improvement_of(tmp_path)
    rl, distilled = (stage for stage in list_stages(improvement) if stage.name in ("rl", "distilled"))
    assert rl.optional(STOPPED)
    write_json(tmp_path / "stages" / "rl.json", {"failed": "stopped: no episode was rewarded"})
    assert f"--policy.path={improvement.plan.policy}" in distilled.command()
    assert [*improvement.policies] == [SFT, FITTED]
    assert not distilled.optional(STOPPED)
    (tmp_path / "rl" / "checkpoints" / "last" / "pretrained_model").mkdir(parents=True)
    assert distilled.optional(STOPPED)
    assert not distilled.optional(1), "the same call goes on with it"


@pytest.mark.parametrize(
    ("kind", "iterations", "freq"),
    [
        (CnnConfig, 1, 1),
        (CnnConfig, 3, 1),
        (CnnConfig, 5, 2),
        (CnnConfig, 60, 15),
        (CnnConfig, None, 10),
        (VQBeTConfig, None, 2),
    ],
)
def test_rl_is_measured_four_times_at_most(
    kind: type[PreTrainedConfig], iterations: int | None, freq: int, tmp_path: Path
) -> None:
    improvement = improvement_of(tmp_path, policy=kind(device="cpu", pretrained_path=tmp_path))
    config = improvement.plan.config
    config.real_env, config.iterations, config.selection_episodes = PushtEnv(), iterations, 1
    made = commands_of(improvement, "rl", "choice")
    assert {f"--selection.freq={freq}", "--selection.n_episodes=1"} <= {*made["rl"]}
    assert {"--n_episodes=1", "--seed=2000001"} <= {*made["choice"]}
    assert all(
        "checkpoints/best/" in improvement.policies[name] for name in {PPO, FITTED} & {*improvement.policies}
    )


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        (CnnConfig, [SFT, PPO, DISTILLED]),
        (ACTConfig, [SFT, FITTED]),
        (VQBeTConfig, [SFT, FITTED]),
    ],
)
def test_only_policies_for_which_it_was_measured_are_fitted_to_a_planner_after_ppo(
    kind: type[PreTrainedConfig], names: list[str], tmp_path: Path
) -> None:
    improvement = improvement_of(tmp_path, policy=kind(device="cpu", pretrained_path=tmp_path))
    assert [*improvement.policies] == names
    improvement.plan.rl_checkpoint.mkdir(parents=True)
    optional = [stage.name for stage in list_stages(improvement) if stage.optional(STOPPED)]
    assert optional == (["rl", "distilled"] if DISTILLED in names else ["rl"])
    assert improvement.chosen() == names[-1]


@pytest.mark.parametrize(
    ("adapters", "pixels", "flags"),
    [
        (False, 2 * 64**2, ["--batch_size=32"]),
        (True, 480 * 640, ["--batch_size=27", "--peft.method_type=LORA"]),
    ],
)
def test_cloning_suits_the_policy_and_its_frames(
    adapters: bool, pixels: int, flags: list[str], small_dataset: Any, tmp_path: Path
) -> None:
    """Without the flag LeRobot writes adapters without the policy's configuration."""
    policy = CnnConfig(device="cpu", pretrained_path=tmp_path, use_peft=adapters)
    improvement = improvement_of(tmp_path, policy=policy, pixels=pixels, failures=2)
    improvement.plan.config.dataset.root = str(small_dataset.root)
    command = commands_of(improvement, "cloned")["cloned"]
    given = [flag for flag in command if flag.startswith(("--batch_size=", "--peft"))]
    assert given == flags
    assert "--dataset.episodes=[0,1,3,4]" in command


def test_a_run_that_selects_nothing_goes_on_where_there_was_no_selection(tmp_path: Path) -> None:
    improvement = improvement_of(tmp_path, failures=2)
    given = settings(improvement.plan.config, list_stages(improvement))
    older = {name: value for name, value in given.items() if name != "selection_episodes"}
    write_json(tmp_path / MARKER, older)
    with Claim(tmp_path, given, marker=MARKER).held():
        pass


def test_a_folder_that_was_begun_with_other_stages_is_refused(tmp_path: Path) -> None:
    """As by a version that did not clone."""
    improvement = improvement_of(tmp_path, failures=2)
    given = settings(improvement.plan.config, list_stages(improvement))
    write_json(tmp_path / MARKER, {**given, "stages": ["tokenizer", "world_model", "check", "rl"]})
    with pytest.raises(ValueError, match="stages"), Claim(tmp_path, given, marker=MARKER).held():
        pass


def test_where_the_strict_threshold_recognises_nothing_the_check_s_own_is_taken(tmp_path: Path) -> None:
    point = {"done_threshold": 0.5, "done_frames": 1}
    for hits, found in ((0, point), (3, None)):
        write_json(tmp_path / "check" / "metrics.json", {"true_positives": hits, "operating_point": point})
        wanted = found or {"done_threshold": 0.95, "done_frames": 2}
        assert {f"--env.{name}={value}" for name, value in wanted.items()} <= {*made_commands(tmp_path)["rl"]}


def test_a_policy_that_seldom_decides_is_named(make_synthetic_dataset: Any, tmp_path: Path) -> None:
    """However long recorded episodes are, an imagined one has at most 98 frames."""
    table = read_episodes(make_synthetic_dataset(tmp_path / "data", episodes=2))
    few = int(np.median(table.length)) // 5
    assert not few_decisions(ACTConfig(device="cpu", n_action_steps=few), table)
    assert not few_decisions(CnnConfig(device="cpu"), table)
    table.length = np.array([600, 600])
    assert (
        "act takes 100 actions at a time, and an imagined episode has about 98 frames"
        in (few_decisions(ACTConfig(device="cpu"), table)[0])
    )


def test_instructions_of_one_outcome_are_named() -> None:
    """Success is told by the instruction: one of which all episodes succeed teaches no failure."""
    table: Any = SimpleNamespace(
        instructions=["push", "push", "pull", "pull", "lift", "lift"],
        success=np.array([True, False, True, True, False, False]),
        column=lambda name: np.arange(6) // 2,
    )
    (warning,) = one_sided_tasks(table)
    assert "3, by which success is told; 1 without a success (such as 'lift')" in warning
    assert "and 1 without a failure (such as 'pull')" in warning
    table.column = lambda name: np.zeros(6)
    assert not one_sided_tasks(table), "other words of one task"
    table.column = lambda name: np.arange(6) // 2
    for success in ([True, False] * 3, [True] * 6):
        table.success = np.array(success)
        assert not one_sided_tasks(table)


@pytest.mark.parametrize(("held", "frames"), [(0, 1), (1, 1), (2, 2), (9, 2)])
def test_success_is_asked_for_no_longer_than_recorded_ones_hold(
    held: int, frames: int, tmp_path: Path
) -> None:
    assert improvement_of(tmp_path, held=held).plan.strict_criterion()["done_frames"] == frames


def test_one_long_recording_does_not_decide_how_long_episodes_usually_are() -> None:
    def usual(lengths: list[int], tasks: list[int]) -> int:
        table: Any = SimpleNamespace(length=np.array(lengths), column=lambda _: np.array(tasks))
        return usual_length(table)

    assert usual([20] * 9 + [9000], [0] * 10) == 20
    assert usual([20] * 9 + [9000] + [50], [0] * 10 + [1]) == 50


@pytest.mark.parametrize(("rollouts", "opened"), [(0, [1]), (5, None)])
def test_a_dataset_that_rollouts_are_merged_with_is_opened_whole(
    rollouts: int, opened: list[int] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LeRobot merges no dataset of which only the chosen episodes' videos were downloaded."""
    asked = []

    def note(source: ChosenEpisodes, episodes: list[int] | None) -> None:
        asked.append(episodes)
        raise InterruptedError

    monkeypatch.setattr(ChosenEpisodes, "_open", note)
    config: Any = SimpleNamespace(
        policy=CnnConfig(), dataset=ChosenEpisodes("data", episodes=[1]), rollouts=rollouts
    )
    with pytest.raises(InterruptedError):
        Plan.of(config)
    assert asked == [opened]
