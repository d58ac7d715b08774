"""The perceptual term: where it goes, and what is said when its network cannot be had."""

from pathlib import Path

import pytest
import torch
from lpips import LPIPS

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.evaluation.image_metrics import image_distance
from lerobot_wmrl.world_models.configuration_frame_tokenizer import FrameTokenizerConfig
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer
from lerobot_wmrl.world_models.perceptual import PerceptualLoss
from tests.trained import run_training, small_tokenizer


@pytest.fixture(scope="module")
def network() -> LPIPS:
    """The real one, but for the weights of its backbone, which need a download."""
    torch.manual_seed(0)
    return LPIPS(net="alex", pnet_rand=True, verbose=False).requires_grad_(False)


def test_the_term_adds_its_weight_times_the_distance_and_teaches_both_halves(network):
    torch.manual_seed(0)
    tokenizer, images = (
        FrameTokenizer(small_tokenizer(image_size=64, widths=[8, 8], levels=[5, 5])),
        torch.rand(2, 1, 3, 64, 64),
    )
    plain, metrics = tokenizer(images)
    assert "perceptual_loss" not in metrics
    loss, metrics = tokenizer(images, perceptual=PerceptualLoss(network, 3.0))
    term = loss - plain
    assert metrics["perceptual_loss"] == pytest.approx(term.item(), rel=1e-4)
    single = tokenizer(images, perceptual=PerceptualLoss(network, 1.0))[1]["perceptual_loss"]
    assert metrics["perceptual_loss"] == pytest.approx(3 * single, rel=1e-5)
    term.backward()
    for half in (tokenizer.encoder, tokenizer.decoder):
        assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in half.parameters())


def test_a_missing_backbone_is_named_before_anything_is_written(small_dataset, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    config = FrameTokenizerConfig(tokenizer=small_tokenizer(), perceptual_weight=1.0, device="cpu")
    message = r"perceptual_weight=1\.0: .*torch/hub/checkpoints/vgg16-.*\.pth is missing.*vgg16\(weights="
    with pytest.raises(ValueError, match=message):
        run_training(config, Path(small_dataset.root), tmp_path / "run")
    assert not (tmp_path / "run").exists()
    assert not (tmp_path / "torch").exists()


def test_a_negative_weight_is_named():
    with pytest.raises(FieldError, match=r"^perceptual_weight=-1\.0: must be at least 0"):
        FrameTokenizerConfig(perceptual_weight=-1.0, device="cpu")


def test_as_a_measure_it_is_a_mean_over_cameras_and_zero_between_equals(network):
    images, distance = torch.rand(3, 2, 3, 64, 64), image_distance(network)
    assert torch.equal(distance(images, images), torch.zeros(3))
    other = images.clone()
    other[0, 1] = 0
    assert distance(other, images)[0] > 0
    alone = network(other[0, 1:], images[0, 1:], normalize=True).squeeze()
    assert distance(other, images)[0] == pytest.approx(alone.item() / 2, rel=1e-4)
