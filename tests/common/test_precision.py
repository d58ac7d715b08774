import pytest
import torch

from lerobot_wmrl.common.precision import (
    compute_in,
    device_setting,
    imagination_dtype,
    multiplies_bfloat16,
    training_dtype,
)


def test_products_are_in_the_chosen_format_and_weights_stay_as_they_are() -> None:
    layer = torch.nn.Linear(4, 4)
    for dtype in (torch.float32, torch.bfloat16):
        with compute_in(dtype, "cpu"):
            assert layer(torch.zeros(2, 4)).dtype == dtype
    assert layer.weight.dtype == torch.float32


def test_float32_switches_a_surrounding_autocast_off() -> None:
    with compute_in(torch.bfloat16, "cpu"), compute_in(torch.float32, "cpu"):
        assert torch.nn.Linear(4, 4)(torch.zeros(2, 4)).dtype == torch.float32


def test_auto_is_what_the_hardware_multiplies_in() -> None:
    fast = torch.bfloat16 if multiplies_bfloat16("cpu") else torch.float32
    assert training_dtype("auto", "cpu") == imagination_dtype("cpu") == fast
    assert training_dtype("float32", "cpu") == torch.float32
    assert training_dtype("bfloat16", "cpu") == torch.bfloat16
    assert not multiplies_bfloat16("meta")


def test_another_precision_is_named() -> None:
    with pytest.raises(ValueError, match=r"^precision=half: choose one of auto, float32, bfloat16"):
        training_dtype("half", "cpu")


@pytest.mark.parametrize(
    ("device", "setting"),
    [
        ("cpu", "cpu"),
        ("cuda:1", "cuda:1"),
        ("cuda", "cuda"),
        ("mps:0", "mps"),
        ("xpu:0", "xpu"),
    ],
)
def test_lerobots_settings_name_devices_without_a_number_but_for_cuda(device: str, setting: str) -> None:
    assert device_setting(torch.device(device)) == setting
