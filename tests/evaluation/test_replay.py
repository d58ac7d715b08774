"""Replays by small trained models on a small dataset, measured and written."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.utils.random_utils import set_seed

from lerobot_wmrl.common.checkpoints import Checkpoint
from lerobot_wmrl.common.constants import KINDS
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.success_criterion import SuccessCriterion
from lerobot_wmrl.data.dataset import ChosenEpisodes, open_dataset
from lerobot_wmrl.data.episodes import choose_episodes, read_episodes
from lerobot_wmrl.data.frames import NO_CONTEXT
from lerobot_wmrl.evaluation import replay as replay_module
from lerobot_wmrl.evaluation import reward_curves
from lerobot_wmrl.evaluation.accuracy import (
    EpisodeAccuracy,
    absolute_control,
    by_step,
    episode_means,
    extreme_actions,
    measure,
    robustness,
)
from lerobot_wmrl.evaluation.gate import gate_at, success_gate
from lerobot_wmrl.evaluation.outcomes import Outcomes
from lerobot_wmrl.evaluation.replay import EpisodeReplay, Recording, replay_episodes
from lerobot_wmrl.evaluation.report import evaluate
from lerobot_wmrl.evaluation.reward_curves import reward_along_episode
from lerobot_wmrl.maniskill.recordings import scene_splits
from lerobot_wmrl.maniskill.scenes import scenes_of
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.scripts.eval_world_model import EvalWorldModelConfig, eval_world_model
from lerobot_wmrl.world_models.checkpoint import load_model
from tests.relabelled import UNLABELLED, relabelled


@pytest.fixture(scope="module")
def model(trained_models):
    return load_model(trained_models["action_world_model"], "action_world_model")


@pytest.fixture
def source(small_dataset, model) -> Recording:
    return Recording.read(read_episodes(small_dataset), model)


def perfect(source: Recording, model, episode: int) -> EpisodeReplay:
    """The replay of an episode by a model that imagines exactly what happened."""
    rows = source.rows(episode)
    following = torch.cat([model.tokenizer.encode(source.images(episode, torch.device("cpu")))[1:]] * 2)
    state, done = torch.from_numpy(source.table.state[rows]), source.table.done[rows]
    length = len(done)
    return EpisodeReplay(
        episode, NO_CONTEXT, following[:length], torch.from_numpy(done).float(), state.roll(-1, 0), None, done
    )


def test_a_perfect_model_reaches_the_ceiling_and_passes_the_gate(source, model):
    runs = [perfect(source, model, episode) for episode in range(6)]
    measured = measure(model, source, runs[0], None)
    assert len(measured.steps["psnr"]) == source.table.length[0] - 1
    np.testing.assert_allclose(measured.steps["psnr"], measured.steps["psnr_ceiling"])
    assert (measured.steps["token_accuracy"] == 1).all()
    assert (measured.steps["tcp_error_mm"] == 0).all()
    np.testing.assert_allclose(measured.steps["tokenizer_lpips"], 0, atol=1e-6)
    gate = gate_at(Outcomes.stack(runs), SuccessCriterion(0.5, 3))
    assert gate.passed
    assert (gate.false_positives.n, gate.recall.n) == (2, 4)


def test_replays_do_not_depend_on_the_batch(source, model, monkeypatch):
    together = {run.episode: run for run in replay_episodes(model, source, np.arange(6))}
    monkeypatch.setattr(replay_module, "BATCH", 2)
    for run in replay_episodes(model, source, np.arange(6)):
        other = together[run.episode]
        assert torch.equal(run.tokens, other.tokens)
        torch.testing.assert_close(run.done_probability, other.done_probability)
        assert (run.shuffled is None) == (other.shuffled is None)
        assert run.shuffled is None or torch.equal(run.shuffled, other.shuffled)
        assert len(run.done) == source.table.length[run.episode]


def test_delta_psnr_compares_with_the_actions_of_another_episode(source, model, monkeypatch):
    alone = next(replay_episodes(model, source, np.array([2])))
    assert alone.shuffled is None
    compared = {run.episode: run for run in replay_episodes(model, source, np.array([2, 5]))}[2]
    assert compared.shuffled is not None
    same = replace(compared, shuffled=compared.tokens[14])
    assert measure(model, source, same, None).whole["delta_psnr_0_6s"] == pytest.approx(0, abs=1e-5)
    assert "delta_psnr_0_6s" not in measure(model, source, alone, None).whole
    monkeypatch.setattr(replay_module, "COMPARED_FRAMES", 14)  # as of data with 500 frames a second
    short = {run.episode: run for run in replay_episodes(model, source, np.array([2, 5]))}[2]
    assert "delta_psnr_0_6s" not in measure(model, source, short, None).whole


def test_depth_is_measured_where_a_replay_has_it(source, model):
    run = perfect(source, model, 0)
    real = torch.full((len(run.done) - 1, 1, 32, 32), 2.0)
    steps = measure(model, source, replace(run, depth=(real, 1.1 * real)), None).steps
    np.testing.assert_allclose(steps["abs_rel"], 0.1, rtol=1e-5)
    assert (steps["delta_1"] == 1).all()


def test_steps_are_averaged_over_the_episodes_that_last_so_long():
    short, long = (EpisodeAccuracy(i, {"psnr": np.full(n, float(10 * n))}, {}) for i, n in enumerate((1, 3)))
    curves = by_step([short, long, EpisodeAccuracy(2, {}, {})], horizon=2)
    assert curves["psnr_by_step"] == [20, 30]
    assert curves["episodes_by_step"] == [2, 1]
    assert curves["bands"]["psnr"][0][0] <= 20 <= curves["bands"]["psnr"][1][0]
    assert by_step([], horizon=2) == {"bands": {}, "episodes_by_step": []}


def test_step_wise_measures_are_averaged_up_to_the_horizon():
    numbers = episode_means(EpisodeAccuracy(0, {"psnr": np.arange(40.0)}, {"mse": 1.0}), horizon=3)
    assert numbers == {"psnr": 1, "mse": 1}


def test_horizons_are_times_not_frames(source, model):
    """At 25 frames a second 1.2 s are 30 frames, more than the episodes have; at 5 they are 6."""
    info = source.table.dataset.meta.info
    run = perfect(source, model, 0)
    assert (source.steps(0.6), source.steps(1.2), source.steps(0.001)) == (15, 30, 1)
    assert "psnr_1_2s" not in measure(model, source, run, None).whole
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(info, "fps", 5)
        measured = measure(model, source, run, None)
    assert measured.whole["psnr_1_2s"] == measured.steps["psnr"][5]
    assert measured.whole["psnr_below_ceiling_1_2s"] == 0


def test_extreme_actions_are_what_they_are_called(source, model):
    own = source.actions(np.arange(6), 4, torch.device("cpu"))
    low, high = source.table.action.min(0), source.table.action.max(0)
    actions = extreme_actions(own, low, high, absolute=False)
    at_a_bound = torch.from_numpy(low), torch.from_numpy(high)
    assert torch.stack([actions["saturated"] == bound for bound in at_a_bound]).any(0).all()
    assert torch.equal(actions["reversed"], -own)
    assert not actions["frozen"].any()
    targets = extreme_actions(own, low, high, absolute=True)
    assert torch.equal(targets["frozen"], own[:, :1].expand_as(own))
    torch.testing.assert_close(targets["reversed"] - targets["frozen"], targets["frozen"] - own)
    assert list(extreme_actions(own, low, high, absolute=None)) == ["saturated"]
    result = robustness(model, source, np.arange(6), SuccessCriterion(1e-9, 1))
    assert result.predicted_success["frozen"].share == 1


def test_actions_are_absolute_where_they_follow_the_state(source):
    table, rng = source.table, np.random.default_rng(0)
    state = np.cumsum(rng.standard_normal((len(table.state), 2)), 0).astype(np.float32)
    still = np.ones((len(state), 1), np.float32)
    targets = replace(table, state=np.hstack([state, still]), action=np.hstack([state + 0.01, still]))
    assert absolute_control(targets) is True
    moves = np.diff(state, axis=0, append=state[-1:])
    assert absolute_control(replace(targets, action=moves)) is False
    assert absolute_control(replace(targets, state=state[:, :0])) is None


def test_splits_compose(small_dataset):
    table = read_episodes(small_dataset)
    assert choose_episodes(table, "all", 4).tolist() == [0, 2, 3, 5]
    held_out = scenes_of("ood")[0].index
    scenes = scene_splits(np.where(table.column("start.scene") == 1, held_out, 0), "ind")
    assert choose_episodes(table, "ind", 6, scenes).tolist() == [0, 2, 4]
    assert choose_episodes(table, "train,ood", 6, scenes).tolist() == [1, 3, 5]
    with pytest.raises(FieldError, match=r"^split=validation: .* has no episode in it"):
        choose_episodes(table, "validation", 4)
    with pytest.raises(FieldError, match=r"^split=test: choose one of train, validation, all, ind, ood"):
        choose_episodes(table, "test", 4, scenes)
    unknown = replace(table, columns={}).column("start.scene")
    with pytest.raises(FieldError, match=r"^split=train,ood: .*does not say which scenes"):
        scene_splits(unknown, "train,ood")
    assert not np.any(scene_splits(unknown, "train")["ind"])


def test_play_is_no_attempt(source, model):
    runs = [perfect(source, model, episode) for episode in range(6)]
    kind = np.array([KINDS.index("play")] * 2 + [KINDS.index("optimal")] * 4)
    assert Outcomes.stack(runs).attempts(
        replace(source.table, columns={"start.kind": kind})
    ).episodes.tolist() == [2, 3, 4, 5]


def test_episodes_of_one_frame_are_named(source, model):
    table = replace(source.table, length=np.ones(6, int))
    with pytest.raises(ValueError, match="every chosen episode has a single frame"):
        evaluate(model, Recording(table, source.frames), np.arange(6))


def test_frames_of_long_episodes_are_compared_in_part_and_outcomes_as_a_whole(source, model, monkeypatch):
    monkeypatch.setattr(replay_module, "COMPARED_FRAMES", 5)
    for run in replay_episodes(model, source, np.arange(2)):
        assert len(run.done) == source.table.length[run.episode]
        assert len(measure(model, source, run, None).steps["psnr"]) == 4


def test_a_criterion_that_every_frame_meets_believes_every_failure(small_dataset, model):
    gate = success_gate(model, Path(small_dataset.root), SuccessCriterion(1e-9, 1))
    assert (gate.false_positives.share, gate.recall.share) == (1, 1)


def test_an_episode_that_ends_without_success_is_a_failure(small_dataset, model, tmp_path):
    """As in LeRobot's own datasets, where `next.done` is the last row's whatever the outcome."""
    table = read_episodes(small_dataset)
    ends = np.isin(np.arange(len(table.done)), table.start + table.length - 1)
    root = relabelled(Path(small_dataset.root), tmp_path / "ends", {"next.done": ends.tolist()})
    assert read_episodes(open_dataset(root)).done.tolist() == table.done.tolist()
    gate = success_gate(model, root, SuccessCriterion())
    assert (gate.false_positives.n, gate.recall.n) == (2, 4)
    root = relabelled(Path(small_dataset.root), tmp_path / "old", {"next.success": None})
    assert read_episodes(open_dataset(root)).done.tolist() == table.done.tolist()
    root = relabelled(Path(small_dataset.root), tmp_path / "unlabelled", UNLABELLED)
    with pytest.raises(ValueError, match=r"neither next\.success nor next\.done"):
        success_gate(model, root, SuccessCriterion())


def test_episodes_of_which_nobody_knows_the_outcome_are_no_failures(small_dataset, trained_models, tmp_path):
    root = relabelled(Path(small_dataset.root), tmp_path / "unlabelled", UNLABELLED)
    config = EvalWorldModelConfig(
        model=Checkpoint(str(trained_models["action_world_model"])),
        dataset=ChosenEpisodes(str(root)),
        output_dir=tmp_path / "check",
    )
    eval_world_model(config)
    metrics = json.loads((tmp_path / "check" / "metrics.json").read_text(), parse_constant=pytest.fail)
    assert (metrics["failures"], metrics["successes"], metrics["passed"]) == (0, 0, False)
    assert metrics["headline"]["done_f1"]["value"] is None
    assert (metrics["headline"]["psnr"]["episodes"], metrics["extreme_actions"]["episodes"]) == (6, 6)


def test_a_long_episode_is_compared_with_the_goal_in_parts(source, model, trained_models, monkeypatch):
    text_model = load_model(trained_models["text_world_model"], "text_world_model")

    def similarity() -> list[float]:
        set_seed(0)
        criterion = SuccessCriterion(0.5, 3)
        found = reward_along_episode(
            text_model,
            GeneralConfig(device="cpu", alpha=0.5),
            source,
            perfect(source, model, 0),
            criterion=criterion,
            longest=8,
        )
        return found["similarity"]

    whole = similarity()
    monkeypatch.setattr(reward_curves, "PART", 7)
    assert similarity() == pytest.approx(whole, abs=1e-5)
    assert len(whole) > 7


def test_success_is_paid_once_in_the_frame_that_completes_it(source, model, trained_models):
    text_model = load_model(trained_models["text_world_model"], "text_world_model")
    replay, frames = perfect(source, model, 0), 3
    probability = torch.ones_like(replay.done_probability)
    probability[[0, 3]] = 0.0  # the first run has two frames
    found = reward_along_episode(
        text_model,
        GeneralConfig(device="cpu", alpha=1.0),
        source,
        replace(replay, done_probability=probability),
        criterion=SuccessCriterion(0.5, frames),
        longest=8,
    )
    count = len(probability) - 1
    assert found["return"] == [0.0] * 6 + [1.0] * (count - 6)
    assert found["done_probability"] == probability[:-1].tolist()
    returns = [
        reward_along_episode(
            text_model,
            GeneralConfig(device="cpu", alpha=0.9),
            source,
            replace(replay, done_probability=probability),
            criterion=SuccessCriterion(0.5, frames),
            longest=longest,
        )["return"][-1]
        for longest in (2, 200)
    ]
    assert returns[0] != returns[1], "progress is rewarded with the discount of the environment"
    assert len(found["similarity"]) == count


def test_the_command_writes_figures_and_pictures(small_dataset, trained_models, tmp_path, capsys):
    folder = tmp_path / "check"
    config = EvalWorldModelConfig(
        model=Checkpoint(str(trained_models["action_world_model"])),
        text_model=Checkpoint(str(trained_models["text_world_model"])),
        dataset=ChosenEpisodes(str(Path(small_dataset.root))),
        split="train,ind",
        output_dir=folder,
    )
    eval_world_model(config)
    metrics = json.loads((folder / "metrics.json").read_text(), parse_constant=pytest.fail)
    assert metrics["failures"] + metrics["successes"] == 6
    longest = read_episodes(small_dataset).length.max()
    for name in ("psnr", "psnr_ceiling", "ssim", "tokenizer_lpips", "token_accuracy", "tcp_error_mm"):
        assert len(metrics[f"{name}_by_step"]) == longest - 1
        low, high = metrics["headline"][name]["bootstrap_95"]
        assert low <= metrics["headline"][name]["value"] <= high
    assert math.isfinite(metrics["delta_psnr_0_6s"])
    assert len(metrics["gate_sweep"]) == 14 * 6
    assert metrics["goal_frames"]["goals"] == 6
    page = (folder / "metrics.md").read_text()
    assert page in capsys.readouterr().out + "\n"
    assert "| PSNR (dB) |" in page
    for name in (
        "comparison_success.gif",
        "comparison_failure_strip.png",
        "goal_frames.png",
        "accuracy.png",
        "gate_sweep.png",
        "reward_along_episodes.png",
    ):
        assert (folder / name).stat().st_size > 0
