"""How like its goal a frame looks."""

import pytest
import torch
from lpips import LPIPS

from lerobot_wmrl.rewards.configuration_rewards import SIMILARITIES, GeneralConfig
from lerobot_wmrl.rewards.similarity import PerceptualSimilarity, Similarity, make_similarity
from lerobot_wmrl.world_models.configuration_frame_tokenizer import TokenizerConfig
from lerobot_wmrl.world_models.frame_tokenizer import Decoded, FrameTokenizer
from lerobot_wmrl.world_models.goal import select_features

CPU = torch.device("cpu")
CAMERAS = 2


@pytest.fixture(scope="module")
def network() -> LPIPS:
    """LPIPS with its own linear heads, on a backbone that was never trained: nothing is downloaded."""
    torch.manual_seed(0)
    return LPIPS(net="alex", pnet_rand=True, verbose=False).requires_grad_(False)


@pytest.fixture(params=["tokenizer", "mse", "lpips"])
def measure(request, network) -> Similarity:
    return PerceptualSimilarity(network) if request.param == "lpips" else make_similarity(request.param, CPU)


def decoded(tokens: torch.Tensor) -> Decoded:
    torch.manual_seed(1)
    tokenizer = FrameTokenizer(TokenizerConfig(["left", "right"], 64, [8, 16], levels=[5, 4])).eval()
    with torch.no_grad():
        return tokenizer.decode_with_features(tokens)


def frames() -> Decoded:
    """A frame, one that differs from it in a few tokens, and one that differs in all of them."""
    tokens = torch.randint(0, 20, (1, CAMERAS * 64), generator=torch.Generator().manual_seed(0))
    near = tokens.clone()
    near[:, :8] = (near[:, :8] + 7) % 20
    return decoded(torch.cat([tokens, near, (tokens + 7) % 20]))


def test_what_is_nearer_to_the_goal_is_more_alike(measure):
    features = measure.features(frames())
    goal = select_features(features, torch.zeros(3, dtype=torch.long), CAMERAS)
    same, near, far = measure(features, goal, CAMERAS).tolist()
    assert same == pytest.approx(1)
    assert 0 <= far < near < same


def test_the_features_of_a_frame_are_those_of_all_its_cameras():
    features, rows = [torch.rand(4 * CAMERAS, 3, 8, 8), torch.rand(4 * CAMERAS, 5)], torch.tensor([2, 0, 2])
    for part, chosen in zip(features, select_features(features, rows, CAMERAS), strict=True):
        assert torch.equal(chosen, part[[4, 5, 0, 1, 4, 5]])


def test_lpips_is_that_of_its_package(network):
    measure, images = PerceptualSimilarity(network), torch.rand(2, 3, CAMERAS, 3, 64, 64)
    a, b = (measure.features(Decoded(part, [])) for part in images)
    expected = network(images[0].flatten(0, 1), images[1].flatten(0, 1), normalize=True).flatten()
    torch.testing.assert_close(measure.distance(a, b), expected, atol=1e-6, rtol=1e-5)


def test_lpips_without_its_backbone_is_an_error_and_never_something_else(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    message = r"reward\.similarity=lpips_alex: .*hub/checkpoints/alexnet-.*\.pth is missing.*tokenizer"
    with pytest.raises(ValueError, match=message):
        make_similarity("lpips_alex", CPU)
    with pytest.raises(ValueError, match=r"^similarity=ssim: choose one of " + ", ".join(SIMILARITIES)):
        GeneralConfig(device="cpu", similarity="ssim")
