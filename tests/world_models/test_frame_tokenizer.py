import pytest
import torch

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.world_models.configuration_frame_tokenizer import FrameTokenizerConfig, TokenizerConfig
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer, feature_distance, motion_weight
from lerobot_wmrl.world_models.modeling_frame_tokenizer import COLLAPSE_STEPS, FrameTokenizerRewardModel


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
    tokenizer = FrameTokenizer(TokenizerConfig(image_size=32, widths=[16, 32], levels=[5, 5, 5]))
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
    tokenizer = FrameTokenizer(
        TokenizerConfig(["left", "right"], image_size=32, widths=[16, 32], levels=[5, 4])
    )
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


def test_white_frames_with_a_small_drawing_do_not_become_one_token():
    """At this learning rate the encoder's vectors grow, and without their normalisation are rounded alike."""
    torch.manual_seed(0)
    tokenizer = FrameTokenizer(TokenizerConfig(image_size=64))
    optimizer = torch.optim.AdamW(tokenizer.parameters(), 2e-3)
    for _ in range(60):
        images = torch.ones(8, 1, 3, 64, 64)
        for image, (row, column) in zip(images, torch.randint(0, 48, (8, 2)).tolist(), strict=True):
            image[:, 0, row : row + 12, column : column + 3] = 0.3
            image[:, 2, row : row + 3, column : column + 12] = 0.3
        loss, metrics = tokenizer(images)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert metrics["token_perplexity"] > 4


def test_a_training_on_frames_of_one_colour_ends_with_the_reason():
    torch.manual_seed(0)
    config = FrameTokenizerConfig(tokenizer=TokenizerConfig(["top"], 32, [8, 16]), device="cpu")
    model = FrameTokenizerRewardModel(config).train()
    batch = {"observation.images.top": torch.full((8, 3, 32, 32), 0.5)}
    moving = {"observation.images.top": torch.rand(8, 3, 32, 32)}
    for _ in range(COLLAPSE_STEPS):
        model(batch, progress=0.0)
    for _ in range(2):
        model(moving, progress=0.2)  # a robot may have waited for a while
        for _ in range(COLLAPSE_STEPS - 1):
            model(batch, progress=0.2)
    with pytest.raises(ValueError, match=r"^distinct_frames: in 20 .*observation\.images\.top.* alike"):
        model(batch, progress=0.2)


def test_motion_counts_more_than_background(frames):
    weight = motion_weight(frames[1:2], frames[0:1])
    assert weight[0, 0, 0, 4, 4] == 5
    assert weight[0, 0, 0, 4, 12] == 5
    assert weight[0, 0, 0, 28, 28] == 1


@pytest.mark.parametrize("image_size", [64, 96, 128, 256])
@pytest.mark.parametrize("quantizer", ["fsq", "lfq"])
def test_any_square_resolution_and_several_cameras(image_size, quantizer):
    tokenizer = FrameTokenizer(
        TokenizerConfig(["left", "right"], image_size, [8, 8, 8], quantizer, [16, 16])
    ).eval()
    images = torch.rand(1, 2, 3, image_size, image_size)
    with torch.no_grad():
        tokens = tokenizer.encode(images)
        decoded = tokenizer.decode(tokens)
    assert tokens.shape == (1, tokenizer.tokens_per_frame) == (1, 2 * (image_size // 16) ** 2)
    assert decoded.shape == images.shape
    half = tokens.shape[1] // 2
    swapped = tokenizer.decode(torch.cat([tokens[:, half:], tokens[:, :half]], 1))
    torch.testing.assert_close(swapped, decoded.flip(1))


def test_fsq_learns_and_reconstructs_as_it_did_before_there_was_a_choice_of_quantizers():
    """Written down before; if a change of the numbers is meant, write the new ones down."""
    torch.manual_seed(0)
    tokenizer = FrameTokenizer(TokenizerConfig(image_size=32, widths=[16, 32], levels=[8, 5, 3]))
    optimizer = torch.optim.Adam(tokenizer.parameters(), 3e-3)
    images = torch.rand(4, 1, 3, 32, 32)
    for _ in range(10):
        loss, _ = tokenizer(images)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss.item() == pytest.approx(0.7631668448448181, rel=1e-5)
    tokens = tokenizer.eval().encode(images)[0]
    assert tokens.tolist() == [60, 51, 51, 53, 60, 51, 68, 60, 68, 59, 67, 67, 60, 51, 51, 59]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"image_size": 30}, r"^tokenizer\.image_size=30: must be a multiple of 8"),
        ({"widths": (16, 36)}, r"^tokenizer\.widths=\[16, 36\]: .*the last a multiple of 8"),
        ({"widths": ()}, r"^tokenizer\.widths=\[\]"),
        ({"levels": (5, 2)}, r"^tokenizer\.levels=\[5, 2\]: .*each of 3 or more"),
        ({"quantizer": "lfq", "levels": (1, 1)}, r"^tokenizer\.levels=\[1, 1\]: .*each of 2 or more"),
        ({"levels": (8, 8, 8, 8, 8, 8, 8)}, r"^tokenizer\.levels=.*2,097,152 codes are more than 1,048,576"),
        ({"levels": (2**16, 2**16), "quantizer": "lfq"}, r"^tokenizer\.levels=.*more than 2,147,483,648"),
        (
            {"quantizer": "lfq"},
            r"^tokenizer\.levels=\[5, 5\]: with `tokenizer\.quantizer`=lfq .*power of two",
        ),
        ({"quantizer": "lfq", "levels": (8, 4)}, r"^tokenizer\.levels=\[8, 4\]: .*the same power"),
        ({"quantizer": "lfq", "levels": (2**13,)}, r"^tokenizer\.levels=\[8192\]: .*at most 4096"),
        ({"quantizer": "vq"}, r"^tokenizer\.quantizer=vq: choose one of fsq, lfq"),
    ],
)
def test_impossible_settings_are_named(settings, message):
    with pytest.raises(FieldError, match=message):
        TokenizerConfig(**{"image_size": 32, "widths": (16, 32), "levels": (5, 5), **settings})


@pytest.mark.parametrize("shape", [(2, 1, 3, 48, 48), (2, 2, 3, 32, 32), (2, 3, 32, 32)])
def test_other_frames_than_the_tokenizers_are_named(shape):
    tokenizer = FrameTokenizer(TokenizerConfig(image_size=32, widths=[8, 8], levels=[5, 5]))
    for use in (tokenizer.encode, tokenizer):
        with pytest.raises(ValueError, match=r"this tokenizer takes .* \(B, 1, 3, 32, 32\)"):
            use(torch.rand(shape))
