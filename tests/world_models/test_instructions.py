"""Success that depends on the instruction: learnt with pictures, read in every kind of imagination."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies.factory import get_policy_class
from torch import Tensor

from lerobot_wmrl.common.checkpoints import Checkpoint
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.dataset import ChosenEpisodes, TrainingData, open_dataset
from lerobot_wmrl.data.episodes import EpisodeTable, count_tasks, read_episodes
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.evaluation.outcomes import predict_done, seen_outcomes
from lerobot_wmrl.evaluation.replay import Recording, replay_episodes
from lerobot_wmrl.play.graphs import instruction_bytes
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.scripts import eval_world_model
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.configuration_frame_tokenizer import TokenizerConfig
from lerobot_wmrl.world_models.configuration_world_model import TextWorldModelConfig
from lerobot_wmrl.world_models.success import SuccessClassifier
from lerobot_wmrl.world_models.text import ByteTextEncoder
from lerobot_wmrl.world_models.training_data import decide_on_instructions, make_joint_sampler, make_sampler
from tests.trained import (
    CLIP_LENGTH,
    PULL,
    PUSH,
    SIZES,
    action_config,
    nested,
    run_training,
    tokenizer_config,
    told_apart,
)

RIGHT, LEFT = "move the square to the right", "move the square to the left"


@pytest.fixture(scope="module")
def two_tasks(make_synthetic_dataset, tmp_path_factory) -> Any:
    """Six episodes with two instructions in turn."""
    return make_synthetic_dataset(tmp_path_factory.mktemp("two") / "tasks", instructions=(PUSH, PULL))


@pytest.fixture(scope="module")
def trained(two_tasks, tmp_path_factory) -> Path:
    """An action world model of both tasks."""
    return told_apart(Path(two_tasks.root), tmp_path_factory.mktemp("instructions"))


@pytest.fixture
def model(trained) -> Any:
    return load_model(trained, "action_world_model")


def first_frames(model: Any, dataset: Any, instructions: list[str]) -> Frames:
    """The first frame of the first episode, once for each instruction."""
    recording = Recording.read(read_episodes(dataset), model)
    frames = recording.starts(model, np.zeros(len(instructions), int))
    return replace(frames, instruction_weights=model.instruction_weights(instructions, len(instructions)))


def moved_squares(count: int, seed: int) -> tuple[Tensor, Tensor, Tensor, list[str]]:
    """A square that has moved to the right or to the left, and whether it was told to.

    Each instruction is followed half of the time, so neither it nor the pictures tell by themselves.
    """
    rng = np.random.default_rng(seed)
    first, frames = torch.zeros(2, count, 1, 3, 32, 32)
    right, asked = rng.random((2, count)) < 0.5
    for row in range(count):
        top, left = rng.integers(4, 24), 14
        first[row, :, :, top : top + 4, left : left + 4] = 1
        left += 8 if right[row] else -8
        frames[row, :, :, top : top + 4, left : left + 4] = 1
    return first, frames, torch.from_numpy(right == asked), [RIGHT if each else LEFT for each in asked]


@pytest.mark.parametrize("reads", [True, False])
def test_the_classifier_learns_success_that_depends_on_the_instruction(reads):
    torch.manual_seed(0)
    classifier = SuccessClassifier(1, reads)
    optimizer = torch.optim.AdamW(classifier.parameters(), 2e-3)
    for step in range(150):
        loss, _ = classifier.loss(*moved_squares(32, step))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(classifier.parameters(), 1.0)
        optimizer.step()
    first, frames, success, instructions = moved_squares(200, 1000)
    with torch.no_grad():
        features = classifier.eval().features(first, frames)
        read = classifier.instructions(instructions) if reads else None
        right = ((classifier.head(features, read) > 0) == success).float().mean()
    assert right > 0.95 if reads else right < 0.7


@pytest.mark.parametrize(
    ("instructions", "tasks", "count"),
    [
        (["push"] * 10 + ["pull"] * 10, [-1] * 20, 2),
        (["push"] * 10 + ["pull"] * 9 + ["pull it"], [-1] * 20, 3),
        ([f"push cube {number // 3}" for number in range(20)], [-1] * 20, 1),
        ([f"push cube {number // 3}" for number in range(20)], [0] * 19 + [2], 2),
        (["push"] * 10 + ["pull"] * 10, [0] * 20, 1),
        (["push"] * 10 + ["pull"] * 10, [0] * 10 + [-1] * 10, 2),
        (["push"] * 20, [-1] * 20, 1),
    ],
)
def test_tasks_are_told_by_their_column_or_by_instructions_that_are_repeated(instructions, tasks, count):
    """In one dataset, or in two."""

    def table(rows: slice) -> Any:
        return SimpleNamespace(instructions=instructions[rows], column=lambda name: np.array(tasks[rows]))

    assert count_tasks([table(slice(20))]) == count_tasks([table(slice(7)), table(slice(7, 20))]) == count


def decided(root: Path, *more: Path, episodes: list[int] | None = None, **settings: Any) -> bool | None:
    """What a new tokenizer is told of its data."""
    config = tokenizer_config(**{"context": True, "success": True, **settings})
    data = TrainingData(root=str(root), episodes=episodes, more=[*map(str, more)])
    decide_on_instructions(config, read_episodes(data.open()), data)
    return config.tokenizer.instructions


@pytest.fixture
def by_instruction(monkeypatch) -> None:
    """Tell tasks by instructions alone, each of which may have a single episode."""
    monkeypatch.setattr(EpisodeTable, "column", lambda table, name: np.full(len(table.start), -1))
    monkeypatch.setattr("lerobot_wmrl.data.episodes.EPISODES_A_TASK", 1)


@pytest.mark.usefixtures("by_instruction")
def test_instructions_are_read_where_what_is_learnt_from_has_several_tasks(
    two_tasks, small_dataset, make_synthetic_dataset, tmp_path
):
    """Further datasets count; episodes that are not chosen do not."""
    two, one = Path(two_tasks.root), Path(small_dataset.root)
    other = Path(make_synthetic_dataset(tmp_path / "pull", episodes=2, length=5, instructions=(PULL,)).root)
    assert decided(two) is True
    assert decided(two, instructions=False) is False
    assert decided(two, episodes=[0, 2, 4]) is False
    assert decided(one) is False
    assert decided(one, other) is True
    assert decided(two, success=False) is None
    config = tokenizer_config(context=True, success=True)
    config.pretrained_path = Path("trained_before_instructions_were_read")
    decide_on_instructions(config, read_episodes(two_tasks), TrainingData(root=str(two)))
    assert not config.tokenizer.instructions


def test_a_training_keeps_what_was_decided(trained, two_tasks, tmp_path):
    """The synthetic datasets' column says that all episodes are of one task."""
    assert load_model(trained, "action_world_model").config.reads_instructions
    config = tokenizer_config(context=True, success=True)
    path = run_training(config, Path(two_tasks.root), tmp_path / "tokenizer")
    assert load_model(path, "frame_tokenizer").config.tokenizer.instructions is False


def test_success_of_the_same_actions_depends_on_the_instruction_alone(model, two_tasks):
    frames = first_frames(model, two_tasks, [PUSH, PULL])
    actions = 0.3 * torch.randn(1, CLIP_LENGTH, 7).repeat(2, 1, 1)
    imagined = model.open_loop(frames, actions)
    assert (imagined.done_logit[0] - imagined.done_logit[1]).abs().min() > 0.01
    assert torch.equal(imagined.tokens[0], imagined.tokens[1])
    torch.testing.assert_close(imagined.state[0], imagined.state[1])


def test_step_by_step_and_at_once_read_the_same_instruction(model, two_tasks):
    """With two sequences for each frame, and beyond a clip too."""
    frames = first_frames(model, two_tasks, [PUSH, PULL])
    for steps in (CLIP_LENGTH - 1, CLIP_LENGTH + 2):
        actions = 0.3 * torch.randn(4, steps, 7)
        at_once = model.open_loop(frames, actions).done_logit
        stepwise = model.imagine(frames[torch.tensor([0, 0, 1, 1])], actions)
        expected = torch.stack([step.done_logit for step in stepwise], 1)
        torch.testing.assert_close(at_once, expected, atol=1e-3, rtol=1e-3)


def test_an_episode_that_begins_anew_has_its_own_instruction(model, two_tasks):
    frames = first_frames(model, two_tasks, [PUSH, PUSH])
    imagination = model.start(frames)
    model.restart(imagination, torch.tensor([False, True]), first_frames(model, two_tasks, [PULL, PULL]))
    action = torch.zeros(2, 7)
    found = model.step(imagination, action).done_logit
    expected = model.step(model.start(first_frames(model, two_tasks, [PUSH, PULL])), action).done_logit
    torch.testing.assert_close(found, expected)
    assert torch.equal(
        model.newest(imagination).instruction_weights,
        first_frames(model, two_tasks, [PUSH, PULL]).instruction_weights,
    )


def test_frames_without_an_instruction_are_refused(model, two_tasks):
    frames = replace(first_frames(model, two_tasks, [PUSH]), instruction_weights=None)
    for imagine in (model.start, lambda each: model.open_loop(each, torch.zeros(1, 3, 7))):
        with pytest.raises(ValueError, match=r"^task: this world model tells success by the instruction"):
            imagine(frames)
    imagination = model.start(first_frames(model, two_tasks, [PUSH]))
    with pytest.raises(ValueError, match=r"^task: this world model"):
        model.restart(imagination, torch.tensor([True]), frames)
    with pytest.raises(ValueError, match=r"^task: 1 instructions for 2 episodes"):
        model.instruction_weights([PUSH], 2)


def test_the_environment_reads_the_instruction_of_each_start(trained, two_tasks):
    config = WorldModelEnv(
        world_model_path=str(trained),
        dataset=StartFrames(root=two_tasks.root),
        done_threshold=0.999,
        reward=GeneralConfig(alpha=1),
    )
    env = config.create_tensor_env(6)
    env.reset(seed=list(range(6)))
    *_, info = env.step(torch.zeros(6, 7))
    texts = [env.starts.instructions[row] for row in range(6)]
    assert texts == [PUSH, PULL] * 3
    model = env.model
    chances = []
    for asked in (texts, texts[::-1]):
        frames = replace(env.starts.frames, instruction_weights=model.instruction_weights(asked, 6))
        chances.append(model.step(model.start(frames), torch.zeros(6, 7)).done_logit.sigmoid())
    torch.testing.assert_close(info["reward_parts"]["done_probability"], chances[0])
    assert (chances[0] - chances[1]).abs().min() > 1e-3


def test_the_gate_and_the_classifiers_verdict_read_the_instruction(model, two_tasks, monkeypatch):
    recording = Recording.read(read_episodes(two_tasks), model)
    judged = {each.episode: each.done_probability for each in predict_done(model, recording)}
    replayed = {each.episode: each for each in replay_episodes(model, recording, np.arange(6))}
    for episode, probability in judged.items():
        expected = replayed[episode].done_probability
        torch.testing.assert_close(probability, expected, atol=1e-3, rtol=1e-3)
    seen = seen_outcomes(model, recording, [0])
    monkeypatch.setattr(recording.table, "instructions", [PULL] * 6)
    other = {each.episode: each.done_probability for each in predict_done(model, recording)}
    assert not torch.allclose(other[0], judged[0], atol=1e-3)
    torch.testing.assert_close(other[1], judged[1])
    assert not np.allclose(seen_outcomes(model, recording, [0]).probability, seen.probability, atol=1e-3)


def test_the_loss_of_done_is_measured_by_the_instruction(model, two_tasks):
    clip = make_sampler(model, read_episodes(two_tasks), None, batch_size=16, seed=0)(0)
    found = model.predict(clip).done_logit
    assert not torch.allclose(model.predict(clip._replace(instructions=[PUSH] * 16)).done_logit, found)
    assert set(clip.instructions) == {PUSH, PULL}


def test_the_planner_needs_the_instruction(trained, two_tasks):
    kind = get_policy_class("wm_mpc")
    config = kind.config_class(
        world_model_path=str(trained),
        horizon=4,
        execute=2,
        knots=2,
        samples=4,
        elites=2,
        iterations=1,
        device="cpu",
    )
    policy = kind(config)
    row = two_tasks[0]
    batch = {key: row[key][None] for key in ("observation.images.third_view", "observation.state")}
    assert policy.select_action({**batch, "task": [PULL]}).shape == (1, 7)
    policy.reset()
    with pytest.raises(ValueError, match=r"^task: 0 instructions for 1 episodes"):
        policy.select_action(batch)


def test_a_text_world_model_reads_success_by_its_instruction_too(two_tasks, trained, tmp_path):
    tokenizer = trained.parent / "frame_tokenizer"
    settings = {**SIZES, "clip_length": CLIP_LENGTH, "goal_horizon": 3}
    config = TextWorldModelConfig(tokenizer_path=str(tokenizer), device="cpu", **nested(settings))
    path = run_training(config, Path(two_tasks.root), tmp_path / "text")
    text = load_model(path, "text_world_model")
    assert text.encode_instructions([PUSH, PULL], 2).instruction_weights.shape[:2] == (2, 1)
    assert text.config.reads_instructions


def test_bytes_of_an_instruction_are_those_of_byt5():
    ids = ByteTextEncoder(8).tokenizer("schiebe das Stück", return_tensors="np")["input_ids"][0]
    found = instruction_bytes("schiebe das Stück")[0]
    assert found[: len(ids)].tolist() == ids.tolist()
    assert not found[len(ids) :].any()
    with pytest.raises(ValueError, match=r"^task: an instruction of 600 bytes; at most 511"):
        instruction_bytes("x" * 600)


@pytest.mark.usefixtures("by_instruction")
@pytest.mark.parametrize("instruction", [" ", "x" * 600])
def test_an_instruction_that_cannot_be_read_is_named_before_training(
    make_synthetic_dataset, trained, tmp_path, caplog, instruction
):
    root = make_synthetic_dataset(tmp_path / "odd", episodes=2, instructions=(PUSH, instruction)).root
    with pytest.raises(FieldError, match=r"tokenizer\.instructions=True: task=.*set it to false"):
        decided(Path(root), instructions=True)
    model = load_model(trained, "action_world_model")
    with pytest.raises(FieldError, match=r"dataset\.root=.*odd: task=.*`tokenizer\.instructions`=false"):
        make_sampler(model, read_episodes(open_dataset(root)), None, batch_size=2, seed=0)
    assert decided(Path(root)) is False
    assert "success is told without the instructions, one of which cannot be read: task=" in caplog.text


def test_so_is_that_of_an_episode_that_is_held_out(
    make_synthetic_dataset, two_tasks, trained, tmp_path, monkeypatch
):
    """It is measured on when the training is over."""
    root = make_synthetic_dataset(tmp_path / "odd", episodes=2, instructions=(PUSH, "x" * 600)).root
    monkeypatch.setattr(EpisodeTable, "validation", property(lambda table: np.arange(len(table.start)) == 1))
    with pytest.raises(FieldError, match=r"tokenizer\.instructions=True: task=.*set it to false"):
        decided(Path(root), instructions=True)
    model, table = load_model(trained, "action_world_model"), read_episodes(open_dataset(root))
    with pytest.raises(FieldError, match=r"dataset\.root=.*odd: task=.*`tokenizer\.instructions`=false"):
        make_sampler(model, table, None, batch_size=2, seed=0)
    assert len(make_sampler(model, table, [0], batch_size=2, seed=0).episodes) == 1
    more = TrainingData(str(two_tasks.root), more=[str(root)])
    make_joint_sampler(
        model, read_episodes(two_tasks), more, batch_size=2, seed=0
    )  # measured on the first alone


def test_an_evaluation_names_it_before_it_replays(
    make_synthetic_dataset, trained, trained_models, tmp_path, monkeypatch
):
    root = make_synthetic_dataset(tmp_path / "odd", episodes=2, instructions=(PUSH, "x" * 600)).root
    monkeypatch.setattr(eval_world_model, "measure", lambda *_: None)
    text = Checkpoint(str(trained_models["text_world_model"]))
    for path, text_model in ((trained, Checkpoint()), (trained_models["action_world_model"], text)):
        config = eval_world_model.EvalWorldModelConfig(
            model=Checkpoint(str(path)),
            text_model=text_model,
            output_dir=tmp_path / path.name,
            dataset=ChosenEpisodes(str(root)),
            device="cpu",
        )
        with pytest.raises(FieldError, match=r"dataset\.root=.*odd: task="):
            eval_world_model.eval_world_model(config)
        config.dataset.episodes = [0]
        eval_world_model.eval_world_model(config)


def test_one_instruction_is_needed_for_each_frame():
    first, frames, success, _ = moved_squares(4, 0)
    with pytest.raises(ValueError, match=r"^task: 1 instructions for 4 episodes"):
        SuccessClassifier(1, instructions=True).loss(first, frames, success, [RIGHT])


def test_several_tasks_are_warned_of_where_the_instruction_is_not_read(
    two_tasks, small_dataset, tmp_path, caplog, by_instruction
):
    config = tokenizer_config(context=True, success=True, instructions=False)
    tokenizer = run_training(config, Path(two_tasks.root), tmp_path / "tokenizer")
    for dataset, warned in ((small_dataset, False), (two_tasks, True)):
        run_training(action_config(tokenizer), Path(dataset.root), tmp_path / str(warned), steps=1)
        assert ("has several tasks, and success is told without the instruction" in caplog.text) == warned


def test_instructions_are_read_with_success_alone():
    with pytest.raises(FieldError, match=r"tokenizer\.instructions=True.*tokenizer\.success"):
        TokenizerConfig(context=True, instructions=True)
