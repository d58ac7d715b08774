"""Two processes that each have half of the environments learn what one process learns from all of them.

Minibatches are whole rollouts here; smaller ones are cut from each process's own, so they differ.
"""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from lerobot_wmrl.common.tracking import read_metrics
from tests.rl.parallel_trainings import ITERATIONS, RUNS, run
from tests.torchrun import torchrun

SCRIPT = Path(__file__).with_name("parallel_trainings.py")


@pytest.fixture(scope="module")
def trained_twice(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folders of all trainings, by one process and by two."""
    one, two = tmp_path_factory.mktemp("one"), tmp_path_factory.mktemp("two")
    for name in RUNS:
        run(name, one / name)
    torchrun(SCRIPT, str(two))
    return one, two


@pytest.mark.parametrize("name", RUNS)
def test_two_processes_log_what_one_does(name: str, trained_twice: tuple[Path, Path]) -> None:
    one, two = (read_metrics(folder / name) for folder in trained_twice)
    assert [line["step"] for line in two] == list(range(ITERATIONS + 1))
    assert two[0]["pause/checkpoint"] == 0
    assert all(line["updates"] > 0 for line in two[1:])
    assert all(0 < line.get("groups_with_signal", 0.5) < 1 for line in two[1:])
    for first, second in zip(one, two, strict=True):
        timeless = [
            {key: value for key, value in line.items() if key[-2:] != "_s"} for line in (first, second)
        ]
        assert timeless[1] == pytest.approx(timeless[0], rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("name", RUNS)
def test_two_processes_learn_what_one_does(name: str, trained_twice: tuple[Path, Path]) -> None:
    checkpoints = [folder / name / "checkpoints" / "last" for folder in trained_twice]
    one, two = (torch.load(folder / "pretrained_model" / "policy.pt") for folder in checkpoints)
    for key, value in one.items():
        torch.testing.assert_close(two[key], value, rtol=1e-3, atol=1e-5)
    one, two = (load_file(folder / "algorithm" / "model.safetensors") for folder in checkpoints)
    assert one.keys() == two.keys()
    for key, value in one.items():
        torch.testing.assert_close(two[key], value, rtol=1e-4, atol=1e-6)


def test_processes_draw_numbers_of_their_own_and_have_the_first_one_s_buffers(
    trained_twice: tuple[Path, Path],
) -> None:
    torch.manual_seed(0)
    module = torch.nn.BatchNorm1d(2)
    module(torch.rand(8, 2))
    alone = torch.rand(3)
    (first, mean), (second, other) = (torch.load(trained_twice[1] / f"apart-{rank}.pt") for rank in range(2))
    torch.testing.assert_close(first, alone)
    assert not torch.isclose(second, first).any()
    torch.testing.assert_close(other, mean, rtol=0, atol=0)
    torch.testing.assert_close(mean, module.running_mean, rtol=0, atol=0)


def test_a_run_goes_on_with_as_many_processes_as_it_began_with(trained_twice: tuple[Path, Path]) -> None:
    with pytest.raises(ValueError, match=r"began with 2 processes, here are 1; .*--nproc_per_node=2"):
        run("grpo", trained_twice[1] / "grpo")
