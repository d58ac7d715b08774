import numpy as np
import pytest
import torch

from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames
from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.evaluation.goals import (
    feature_distances,
    final_rows,
    goal_quality,
    held_out_from_probe,
    imagine_goals,
    labelled_frames,
    least,
    train_probe,
)
from lerobot_wmrl.evaluation.pictures import save_goals
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.configuration_frame_tokenizer import TokenizerConfig
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer, feature_distance


class Lossless(torch.nn.Module):
    """A tokenizer that keeps every pixel, so that only the probe is tested."""

    num_cameras = 1

    def __init__(self) -> None:
        super().__init__()
        self.nothing = torch.nn.Parameter(torch.zeros(1))

    def context(self, images: torch.Tensor) -> Context:
        return NO_CONTEXT

    def encode(self, images: torch.Tensor, context: Context) -> torch.Tensor:
        return images

    def decode(self, tokens: torch.Tensor, context: Context) -> torch.Tensor:
        return tokens


@pytest.fixture(scope="module")
def text_model(trained_models):
    return load_model(trained_models["text_world_model"], "text_world_model")


def source_of(dataset, keys) -> Recording:
    return Recording(read_episodes(dataset), cached_frames(dataset, keys, 32))


def test_the_least_allowed_distance_counts():
    distance = np.array([[3.0, 1.0, 2.0], [1.0, 2.0, 3.0], [1.0, 2.0, 3.0]])
    allowed = np.array([[True, False, True], [True, True, True], [False, False, False]])
    value, index = least(distance, allowed)
    assert index.tolist() == [2, 0, -1]
    assert value[:2].tolist() == [2, 1]
    assert np.isnan(value[2])


def test_distances_of_all_pairs_average_over_cameras():
    torch.manual_seed(0)
    tokenizer = FrameTokenizer(TokenizerConfig(["left", "right"], 16, [8, 16], levels=[5, 4])).eval()
    with torch.no_grad():
        goals, finals = (
            tokenizer.decode_with_features(torch.randint(0, 20, (n, 8))).features for n in (2, 3)
        )
    expected = feature_distance([layer[2:4] for layer in goals], [layer[4:6] for layer in finals]).mean()
    distances = feature_distances(goals, finals, 2)
    assert distances.shape == (2, 3)
    assert distances[1, 2] == pytest.approx(expected.item(), rel=1e-5)


def test_a_final_frame_is_the_first_in_which_success_holds(small_dataset, text_model):
    source = source_of(small_dataset, text_model.config.tokenizer.camera_keys)
    episodes, rows = final_rows(source)
    assert episodes.tolist() == source.table.success.nonzero()[0].tolist()
    assert source.table.done[rows - 1].all()
    assert not source.table.done[rows - 2].any()


def test_goals_are_compared_with_real_successes(small_dataset, text_model):
    source = source_of(small_dataset, text_model.config.tokenizer.camera_keys)
    goals = imagine_goals(text_model, source, np.arange(6))
    assert set(goals.nearest) <= set(range(len(goals.finals.episodes)))
    quality = goal_quality(goals, train_probe(text_model.tokenizer, source))
    assert quality["nearest_final_tokenizer_lpips"]["episodes"] == 6
    assert quality["success_holds"]["n"] == 6
    assert quality["success_holds_in_finals"]["n"] == held_out_from_probe(goals.finals.episodes).sum() == 1


def test_without_a_real_success_there_is_no_distance_and_no_probe(small_dataset, text_model, tmp_path):
    source = source_of(small_dataset, text_model.config.tokenizer.camera_keys)
    source.table.done[:] = False
    goals = imagine_goals(text_model, source, np.arange(6))
    probe = train_probe(text_model.tokenizer, source)
    assert probe is None
    quality = goal_quality(goals, probe)
    save_goals(goals, tmp_path / "goals.png")
    assert quality["nearest_final_tokenizer_lpips"]["value"] is None
    assert quality["nearest_final_psnr"]["value"] is None
    assert "success_holds" not in quality


def test_labels_belong_to_the_frame_an_action_led_to(small_dataset):
    source = source_of(small_dataset, ["observation.images.third_view"])
    data = labelled_frames(Lossless(), source, np.ones(6, bool), np.random.default_rng(0))
    assert data.success.float().mean() == 0.5
    labels: dict[bytes, set[bool]] = {}
    for row in np.setdiff1d(np.arange(len(source.frames)), source.table.start):
        labels.setdefault(source.frames[row].tobytes(), set()).add(bool(source.table.done[row - 1]))
    for image, success in zip(data.images, data.success, strict=True):
        pixels = torch.nn.functional.interpolate(image, (32, 32), mode="area")
        frame = (pixels * 255).round().byte().permute(0, 2, 3, 1).numpy()
        assert bool(success) in labels[frame.tobytes()]


def test_the_probe_tells_success_in_episodes_it_has_not_seen(make_synthetic_dataset, tmp_path):
    """A square pushed by a tenth of a metre: whether it went so far shows only beside where it began."""
    dataset = make_synthetic_dataset(tmp_path / "dataset", episodes=40)
    probe = train_probe(Lossless(), source_of(dataset, ["observation.images.third_view"]))
    assert probe.held_out_frames > 30
    assert probe.balanced_accuracy > 0.85
