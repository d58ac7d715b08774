import pytest
import torch

from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer, feature_distance, motion_weight


@pytest.fixture(scope="module")
def frames() -> torch.Tensor:
    """A white square at 16 places on grey, (16, 1, 3, 32, 32)."""
    images = torch.full((16, 1, 3, 32, 32), 0.4)
    for index in range(16):
        row, column = 8 * (index // 4), 8 * (index % 4)
        images[index, :, :, row : row + 8, column : column + 8] = 1.0
    return images


@pytest.fixture(scope="module")
def trained(frames: torch.Tensor) -> FrameTokenizer:
    torch.manual_seed(0)
    tokenizer = FrameTokenizer(32, (16, 32), (5, 5, 5))
    optimizer = torch.optim.Adam(tokenizer.parameters(), 3e-3)
    for _ in range(150):
        loss, _ = tokenizer(frames)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return tokenizer.eval()


def test_it_overfits_a_batch(trained, frames):
    with torch.no_grad():
        error = (trained.decode(trained.encode(frames)) - frames).square().mean()
    assert -10 * torch.log10(error) > 25


def test_tokens_are_a_grid_a_camera_within_the_codebook():
    tokenizer = FrameTokenizer(32, (16, 32), (5, 4), num_cameras=2)
    tokens = tokenizer.encode(torch.rand(3, 2, 3, 32, 32))
    assert tokens.shape == (3, 2 * 4 * 4)
    assert tokens.dtype == torch.int64
    assert tokens.min() >= 0
    assert tokens.max() < 20
    assert tokenizer.decode(tokens).shape == (3, 2, 3, 32, 32)


def test_feature_distance_is_zero_for_the_same_frame_and_grows_with_the_change(trained, frames):
    moved = torch.stack([frames[0], frames[1]])
    with torch.no_grad():
        same, near = (trained.decode_with_features(trained.encode(x[None])).features for x in moved)
        none = trained.decode_with_features(trained.encode(torch.full_like(frames[:1], 0.4))).features
    assert feature_distance(same, same).item() == pytest.approx(0, abs=1e-6)
    assert 0.01 < feature_distance(same, none).item() < feature_distance(same, near).item()


def test_motion_counts_more_than_background(frames):
    weight = motion_weight(frames[1:2], frames[0:1], strength=4.0)
    assert weight[0, 0, 0, 4, 4] == 5
    assert weight[0, 0, 0, 4, 12] == 5
    assert weight[0, 0, 0, 28, 28] == 1


def test_a_size_off_the_grid_is_refused():
    with pytest.raises(ValueError, match="image_size=30"):
        FrameTokenizer(30, (16, 32), (5, 5))
