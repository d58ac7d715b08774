"""Success that depends on the instruction: learnt with pictures, read in every kind of imagination."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies.factory import get_policy_class
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.evaluation.gate import predict_done, seen_outcomes
from lerobot_wmrl.evaluation.replay import Recording, replay_episodes
from lerobot_wmrl.play.graphs import ExportedWorldModel, export_graphs, instruction_bytes
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.configuration_frame_tokenizer import TokenizerConfig
from lerobot_wmrl.world_models.configuration_world_model import TextWorldModelConfig
from lerobot_wmrl.world_models.modeling_frame_tokenizer import FrameTokenizerRewardModel
from lerobot_wmrl.world_models.success import SuccessClassifier
from lerobot_wmrl.world_models.text import ByteTextEncoder
from lerobot_wmrl.world_models.training import make_sampler
from tests.trained import (
    CLIP_LENGTH,
    PULL,
    PUSH,
    SIZES,
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
    return replace(frames, instruction=model.read_instructions(instructions, len(instructions)))


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


def test_a_dataset_decides_whether_instructions_are_read(trained, two_tasks, small_dataset):
    """Several are, unless it is asked not to; a single one is not."""

    def reads(dataset: Any, **settings: Any) -> bool:
        config = tokenizer_config(context=True, **settings)
        tokenizer = FrameTokenizerRewardModel(config, dataset_meta=dataset.meta)
        assert (tokenizer.tokenizer.success is not None) == settings.get("success", False)
        return tokenizer.config.tokenizer.instructions

    assert reads(two_tasks, success=True) is True
    assert reads(two_tasks, success=True, instructions=False) is False
    assert reads(small_dataset, success=True) is False
    assert reads(two_tasks) is False
    assert load_model(trained, "action_world_model").config.reads_instructions


def test_a_tokenizer_from_before_instructions_were_read_does_not_begin_to(two_tasks):
    config = tokenizer_config(context=True, success=True)
    config.pretrained_path = Path("trained_before")
    model = FrameTokenizerRewardModel(config, dataset_meta=two_tasks.meta)
    assert model.tokenizer.success.instructions is None


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
        model.newest(imagination).instruction, first_frames(model, two_tasks, [PUSH, PULL]).instruction
    )


def test_frames_without_an_instruction_are_refused(model, two_tasks):
    frames = replace(first_frames(model, two_tasks, [PUSH]), instruction=None)
    for imagine in (model.start, lambda each: model.open_loop(each, torch.zeros(1, 3, 7))):
        with pytest.raises(ValueError, match=r"^task: this world model tells success by the instruction"):
            imagine(frames)
    imagination = model.start(first_frames(model, two_tasks, [PUSH]))
    with pytest.raises(ValueError, match=r"^task: this world model"):
        model.restart(imagination, torch.tensor([True]), frames)
    with pytest.raises(ValueError, match=r"^task: 1 instructions for 2 episodes"):
        model.read_instructions([PUSH], 2)


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
        frames = replace(env.starts.frames, instruction=model.read_instructions(asked, 6))
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
        world_model_path=str(trained), horizon=4, execute=2, knots=2, samples=4, elites=2, iterations=1,
        device="cpu",
    )  # fmt: skip
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
    assert text.encode_instructions([PUSH, PULL], 2).instruction.shape[:2] == (2, 1)
    assert text.config.reads_instructions


def test_graphs_of_a_page_read_the_instruction_as_the_model_does(model, two_tasks, tmp_path):
    """From its bytes: a page has no tokenizer."""
    export_graphs(model, tmp_path)
    exported = ExportedWorldModel(tmp_path, CLIP_LENGTH)
    recording = Recording.read(read_episodes(two_tasks), model)
    pictures = recording.images(0, torch.device("cpu"))[:1].numpy()
    state = recording.table.state[:1]
    chances = []
    for text in (PUSH, PULL):
        exported.begin(pictures, state, text)
        chances.append(exported.step(np.zeros((1, 7), np.float32))["done_probability"])
    logits = torch.from_numpy(np.concatenate(chances)).logit()
    expected = model.step(model.start(first_frames(model, two_tasks, [PUSH, PULL])), torch.zeros(2, 7))
    torch.testing.assert_close(logits, expected.done_logit, atol=0.1, rtol=0.05)
    assert abs(logits[0] - logits[1]) > 1


def test_bytes_of_an_instruction_are_those_of_byt5():
    ids = ByteTextEncoder(8).tokenizer("schiebe das Stück", return_tensors="np")["input_ids"][0]
    found = instruction_bytes("schiebe das Stück")[0]
    assert found[: len(ids)].tolist() == ids.tolist()
    assert not found[len(ids) :].any()
    with pytest.raises(ValueError, match=r"^task: an instruction of 600 bytes; at most 511"):
        instruction_bytes("x" * 600)


@pytest.mark.parametrize("instruction", [" ", "x" * 600])
def test_an_instruction_that_cannot_be_read_is_named_before_training(
    make_synthetic_dataset, tmp_path, instruction
):
    root = make_synthetic_dataset(tmp_path / "odd", episodes=2, instructions=(PUSH, instruction)).root
    config = tokenizer_config(context=True, success=True)
    with pytest.raises(FieldError, match=r"tokenizer\.instructions=True: task=.*set it to false"):
        run_training(config, Path(root), tmp_path / "tokenizer")
    run_training(
        tokenizer_config(context=True, success=True, instructions=False), Path(root), tmp_path / "tokenizer"
    )


def test_instructions_are_read_with_success_alone():
    with pytest.raises(FieldError, match=r"tokenizer\.instructions=True.*tokenizer\.success"):
        TokenizerConfig(context=True, instructions=True)
