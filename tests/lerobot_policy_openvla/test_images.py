"""Pictures are squashed as Pillow squashes them, and what is no picture is refused."""

import numpy as np
import pytest
import torch
from PIL import Image

from lerobot_policy_openvla.images import resize, to_pixel_values


@pytest.mark.parametrize("size", [224, 64, 56])
@pytest.mark.parametrize(
    ("height", "width"),
    [
        (256, 256),
        (480, 640),
        (64, 64),
        (31, 47),
        (1, 1),
        (225, 223),
        (2, 500),
        (720, 1280),
    ],
)
def test_resizing_is_pillows_bit_by_bit(height: int, width: int, size: int) -> None:
    """Hard edges too, where the filter overshoots and is clipped."""
    picture = np.random.default_rng(height).integers(0, 256, (height, width, 3), dtype=np.uint8)
    picture[::2] = (picture[::2] > 128) * 255
    expected = np.asarray(Image.fromarray(picture).resize((size, size), Image.Resampling.BICUBIC))
    found = resize(torch.from_numpy(picture).permute(2, 0, 1)[None], size, size)
    assert np.array_equal(found[0].permute(1, 2, 0).numpy(), expected)


def test_numbers_and_bytes_are_the_same_picture() -> None:
    images = torch.randint(0, 256, (2, 3, 40, 50), dtype=torch.uint8)
    pixel_values = to_pixel_values(images, 32)
    assert pixel_values.shape == (2, 6, 32, 32)
    assert torch.equal(pixel_values, to_pixel_values(images.float() / 255, 32))


def test_the_two_halves_are_one_picture_normalised_twice() -> None:
    dino, siglip = to_pixel_values(torch.rand(1, 3, 32, 32), 32).split(3, dim=1)
    mean, std = (
        torch.tensor(value).view(3, 1, 1) for value in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
    )
    assert torch.allclose(dino * std + mean, siglip * 0.5 + 0.5, atol=1e-6)


@pytest.mark.parametrize(
    "images",
    [
        torch.zeros(3, 32, 32),
        torch.zeros(2, 32, 32, 3),
        torch.zeros(1, 1, 32, 32),
        torch.zeros(1, 3, 32, 32, dtype=torch.int64),
    ],
)
def test_what_is_no_batch_of_pictures_is_refused(images: torch.Tensor) -> None:
    with pytest.raises(ValueError, match=r"needs \(B, 3, H, W\), torch\.uint8 or floating"):
        to_pixel_values(images, 32)
