"""The context-conditioned tokenizer: all is read and written beside the first frame."""

from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_wmrl.common.checkpoints import Checkpoint
from lerobot_wmrl.common.images import to_pixels
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames, cached_tokens, frames_to_tensor
from lerobot_wmrl.data.frames import NO_CONTEXT
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.envs.start_frames import GOLDEN_RATIO, read_start_images
from lerobot_wmrl.evaluation.pictures import side_by_side
from lerobot_wmrl.evaluation.replay import Recording, replay_episodes
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.scripts.eval_world_model import EvalWorldModelConfig, eval_world_model
from lerobot_wmrl.world_models.autoencoder import Fusion
from lerobot_wmrl.world_models.checkpoint import load_model, read_config
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer
from lerobot_wmrl.world_models.training_data import make_sampler
from tests.trained import action_config, run_training, small_tokenizer, text_config, tokenizer_config

CAMERA = "observation.images.third_view"


@pytest.fixture(scope="module")
def models(small_dataset, tmp_path_factory) -> dict[str, Path]:
    """A conditioned tokenizer and both world models on it, a few steps each."""
    root, folder = Path(small_dataset.root), tmp_path_factory.mktemp("conditioned")
    config = tokenizer_config(context=True)
    tokenizer = run_training(config, root, folder / "frame_tokenizer")
    return {
        "frame_tokenizer": tokenizer,
        "action_world_model": run_training(action_config(tokenizer), root, folder / "action"),
        "text_world_model": run_training(text_config(tokenizer), root, folder / "text"),
    }


@pytest.fixture(scope="module")
def table(small_dataset):
    return read_episodes(small_dataset)


@pytest.fixture(scope="module")
def frames(small_dataset) -> np.ndarray:
    return cached_frames(small_dataset, [CAMERA], 32)


def scenes() -> tuple[torch.Tensor, torch.Tensor]:
    """Sixteen scenes of random stripes, and the same with a white square somewhere. (16, 1, 3, 32, 32)"""
    generator = torch.Generator().manual_seed(0)
    start = torch.rand(16, 1, 3, 32, 1, generator=generator).expand(-1, -1, -1, -1, 32).contiguous()
    frames = start.clone()
    for index in range(16):
        row, column = 8 * (index // 4), 8 * (index % 4)
        frames[index, :, :, row : row + 8, column : column + 8] = 1.0
    return start, frames


@torch.no_grad()
def test_a_fusion_convolves_features_and_context_side_by_side() -> None:
    """What it computes beforehand on behalf of the context changes nothing of that."""
    fusion, (x, context) = Fusion(8), torch.randn(2, 3, 8, 4, 4, generator=torch.Generator().manual_seed(0))
    expected = x + fusion.mix(torch.nn.functional.silu(torch.cat([x, context], 1)))
    torch.testing.assert_close(fusion(x, fusion.project(context)), expected)


@torch.no_grad()
def test_static_detail_comes_from_the_first_frame_and_not_through_the_tokens():
    """Three codes a token cannot describe the stripes; what moved they can."""
    start, frames = scenes()
    errors = {}
    for conditioned in (False, True):
        torch.manual_seed(0)
        tokenizer = FrameTokenizer(small_tokenizer(widths=[16, 32], levels=[3], context=conditioned))
        optimizer = torch.optim.Adam(tokenizer.parameters(), 5e-3)
        with torch.enable_grad():
            for _ in range(100):
                loss, _ = tokenizer(frames, context=tokenizer.context(start))
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
        tokenizer.eval()
        context = tokenizer.context(start)
        decoded = tokenizer.decode(tokenizer.encode(frames, context), context)
        errors[conditioned] = (decoded - frames).square().mean().item()
    assert errors[True] < errors[False] / 3


@torch.no_grad()
def test_a_row_is_decoded_beside_its_own_context():
    start, frames = scenes()
    tokenizer = FrameTokenizer(small_tokenizer(context=True)).eval()
    context = tokenizer.context(start)
    tokens = tokenizer.encode(frames, context)
    order = torch.randperm(16)
    torch.testing.assert_close(
        tokenizer.decode(tokens[order], context[order]), tokenizer.decode(tokens, context)[order]
    )
    assert not torch.allclose(tokenizer.decode(tokens, context[order]), tokenizer.decode(tokens, context))


def test_a_missing_superfluous_or_short_context_is_named():
    start, frames = scenes()
    plain, conditioned = (
        FrameTokenizer(small_tokenizer(widths=[8, 8], levels=[5], context=context))
        for context in (False, True)
    )
    context = conditioned.context(start)
    tokens = plain.encode(frames)
    assert plain.context(start) is NO_CONTEXT
    for call in (
        lambda: conditioned.encode(frames),
        lambda: conditioned.decode(tokens),
        lambda: conditioned(frames),
        lambda: conditioned.decode(tokens, context[:3]),
        lambda: plain.encode(frames, context),
    ):
        with pytest.raises(ValueError, match=r"the context of \d+ first frames: this tokenizer needs"):
            call()


@torch.no_grad()
def test_cached_tokens_are_those_beside_the_episodes_first_frame(models, small_dataset, table, frames):
    tokenizer = load_model(models["frame_tokenizer"], "frame_tokenizer").tokenizer
    tokens = cached_tokens(small_dataset, [CAMERA], tokenizer)
    for start, length in zip(table.start, table.length, strict=True):
        images = frames_to_tensor(frames[start : start + length])
        context = tokenizer.context(images[:1])[[0] * length]
        assert np.array_equal(tokens[start : start + length], tokenizer.encode(images, context))


@torch.no_grad()
def test_clips_carry_what_the_tokenizer_sees_in_their_episodes_first_frame(
    models, small_dataset, table, frames
):
    """And may therefore say in the midst of an episode whether it has succeeded."""
    model = load_model(models["action_world_model"], "action_world_model")
    sampler = make_sampler(model, table, None, batch_size=4, seed=0)
    clip = sampler.clips(np.array([2, 0]), np.array([3, 0]))
    expected = model.tokenizer.context(frames_to_tensor(frames[table.start[[2, 0]]])).features
    torch.testing.assert_close(clip.context.features, expected)
    assert torch.equal(clip.done_known, clip.valid)
    model.config.tokenizer.context = False
    plain = make_sampler(model, table, None, batch_size=4, seed=0)
    clip = plain.clips(np.array([2, 0]), np.array([3, 0]))
    assert clip.context is NO_CONTEXT
    assert clip.valid[0].any()
    assert not clip.done_known[0].any()


@torch.no_grad()
def test_environments_decode_beside_their_own_start_also_after_a_restart(models, small_dataset):
    config = WorldModelEnv(
        world_model_path=str(models["action_world_model"]),
        text_world_model_path=str(models["text_world_model"]),
        dataset=StartFrames(str(small_dataset.root), split="all"),
        episode_length=3,
    )
    env = config.create_tensor_env(4)
    starts = env.starts
    assert len(starts.frames.context) == len(starts)
    env.reset(seed=0)
    before = env._start_index.clone()
    for step in range(4):
        observation, *_, info = env.step(torch.zeros(4, 7))
        if step == 2:
            assert torch.equal(observation[CAMERA], starts.images[env._start_index][:, 0])
            observation = info["final_obs"]
        tokens = env.model.dynamics.network.codebook.tokens(env._imagination.codes[:, 0])
        start = before if step < 3 else env._start_index
        if step != 2:
            expected = env.model.decode(tokens, starts.frames.context[start]).images[:, 0]
            torch.testing.assert_close(observation[CAMERA], expected)
    assert not torch.equal(before, env._start_index)


def test_imagined_episodes_branch_off_from_recorded_ones_before_their_success(models, small_dataset, table):
    """From frames spread over what comes before it, each beside the first frame of its episode; the episodes
    in an order that spreads over the dataset."""
    starts = StartFrames(root=str(Path(small_dataset.root)), branches=2)
    path = str(models["action_world_model"])
    reward = GeneralConfig(alpha=1.0)
    env = WorldModelEnv(world_model_path=path, dataset=starts, reward=reward, device="cpu")
    frames = read_start_images(starts, read_config(path, "action_world_model"))
    last = []
    for start, length in zip(table.start, table.length, strict=True):
        solved = np.flatnonzero(table.done[start : start + length])
        last.append(min([length - 1, *solved[:1]]))
    order = np.argsort(np.arange(len(last)) * GOLDEN_RATIO % 1)
    begun = table.start[order]
    expected = (begun[:, None] + np.array(last)[order, None] * np.arange(3) // 3).flatten()
    np.testing.assert_array_equal(frames.state, table.state[expected])
    assert not table.done[expected].any()
    tensor_env = env.create_tensor_env(len(expected))
    observation, _ = tensor_env.reset(seed=list(range(len(expected))))
    torch.testing.assert_close(observation["observation.state"], torch.from_numpy(table.state[expected]))
    first = frames_to_tensor(cached_frames(small_dataset, [CAMERA], 32)[np.repeat(begun, 3)])
    torch.testing.assert_close(
        tensor_env.starts.frames.context.maps, tensor_env.model.tokenizer.context(first).maps
    )


def test_branches_need_a_world_model_that_knows_how_the_episode_began(trained_models, small_dataset):
    starts = StartFrames(root=str(Path(small_dataset.root)), branches=1)
    with pytest.raises(ValueError, match=r"^dataset\.branches=1: .* `model.tokenizer.context=true`"):
        read_start_images(starts, read_config(trained_models["action_world_model"], "action_world_model"))


def test_evaluation_decodes_beside_the_start_and_runs_whole(models, small_dataset, table, frames, tmp_path):
    model = load_model(models["action_world_model"], "action_world_model")
    source = Recording(table, frames)
    for run in replay_episodes(model, source, np.array([3, 1])):
        context = model.tokenizer.context(frames_to_tensor(frames[table.start[[run.episode]]]))
        expected = to_pixels(model.tokenizer.decode(run.tokens[:1], context).detach())[0, 0]
        assert np.array_equal(side_by_side(model, source, run)[1, -len(expected) :], expected)
    eval_world_model(
        EvalWorldModelConfig(
            model=Checkpoint(str(models["action_world_model"])),
            text_model=Checkpoint(str(models["text_world_model"])),
            dataset=ChosenEpisodes(str(small_dataset.root)),
            output_dir=tmp_path / "evaluation",
        )
    )
    assert (tmp_path / "evaluation" / "goal_frames.png").is_file()


@torch.no_grad()
def test_rewards_of_batches_take_the_context_from_the_batch(models):
    """A window's own first frame for the text world model, `reference.*` for the tokenizer."""
    images = torch.rand(2, 4, 3, 32, 32)
    text = load_model(models["text_world_model"], "text_world_model")
    batch = {
        CAMERA: images,
        "observation.state": torch.zeros(2, 4, 8),
        "action": torch.zeros(2, 4, 7),
        "task": ["a", "b"],
    }
    clip = text.clip_from_batch(batch)
    context = text.tokenizer.context(images[:, :1])
    assert torch.equal(clip.tokens[:, 2], text.tokenizer.encode(images[:, 2:3], context))
    assert text.compute_reward(batch).shape == (2,)
    tokenizer = load_model(models["frame_tokenizer"], "frame_tokenizer")
    frame = {CAMERA: images[:, 1], "goal.third_view": images[:, 1], "reference.third_view": images[:, 0]}
    torch.testing.assert_close(tokenizer.compute_reward(frame), torch.ones(2))
    del frame["reference.third_view"]
    with pytest.raises(
        ValueError, match=r"^tokenizer\.context=True: the batch lacks \['reference\.third_view'\]"
    ):
        tokenizer(frame)
