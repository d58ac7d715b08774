from dataclasses import replace

import numpy as np
import pytest
import torch

from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames
from lerobot_wmrl.evaluation.goals import (
    feature_distances,
    final_rows,
    goal_quality,
    imagine_goals,
    least,
)
from lerobot_wmrl.evaluation.pictures import save_goals
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.evaluation.success_probe import held_out_from_probe, train_probe
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.configuration_frame_tokenizer import TokenizerConfig
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer, feature_distance


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
    chosen = np.arange(6) < 2
    assert final_rows(replace(source, chosen=chosen))[0].tolist() == [0, 1], "of others no video may be here"


def test_goals_are_compared_with_real_successes(small_dataset, text_model):
    source = source_of(small_dataset, text_model.config.tokenizer.camera_keys)
    goals = imagine_goals(text_model, source, np.arange(6))
    assert set(goals.nearest) <= set(range(len(goals.finals.episodes)))
    quality = goal_quality(goals, train_probe(text_model.tokenizer, source))
    assert quality.nearest_final_tokenizer_lpips.n == 6
    assert quality.success_holds.n == 6
    assert quality.success_holds_in_finals.n == held_out_from_probe(goals.finals.episodes).sum() == 1


def test_without_a_real_success_there_is_no_distance_and_no_probe(small_dataset, text_model, tmp_path):
    source = source_of(small_dataset, text_model.config.tokenizer.camera_keys)
    source.table.done[:] = False
    goals = imagine_goals(text_model, source, np.arange(6))
    probe = train_probe(text_model.tokenizer, source)
    assert probe is None
    quality = goal_quality(goals, probe).as_json()
    save_goals(goals, tmp_path / "goals.png")
    assert quality["nearest_final_tokenizer_lpips"]["value"] is None
    assert quality["nearest_final_psnr"]["value"] is None
    assert "success_holds" not in quality
