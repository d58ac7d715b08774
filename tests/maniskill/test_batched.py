"""The batched simulation against the single one: the same starts, pictures and judgements.

Without CUDA a batch holds one episode: masks and rows are tested with the environment, on a made-up table.
"""

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from lerobot_wmrl.maniskill.batched import BatchedSimulation
from lerobot_wmrl.maniskill.cameras import Rendering
from lerobot_wmrl.maniskill.scenes import SCENES
from lerobot_wmrl.maniskill.simulation import Simulation
from lerobot_wmrl.maniskill.tasks import TASKS

PAIRS = [(0, 5), (30, 6), (77, 1_000_000)]
STEPS = 20


@pytest.fixture(scope="module")
def batched() -> Iterator[BatchedSimulation]:
    simulation = BatchedSimulation(TASKS["push"], SCENES, Rendering(image_size=64), 1, "cpu")
    yield simulation
    simulation.close()


@pytest.mark.parametrize("task", list(TASKS))
@pytest.mark.parametrize(("scene", "seed"), PAIRS)
def test_starts_are_those_of_the_single_simulation(
    batched: BatchedSimulation, simulation: Simulation, task: str, scene: int, seed: int
) -> None:
    batched.task = simulation.task = TASKS[task]
    many = batched.reset([SCENES[scene]], [seed], [0])
    one = simulation.reset(SCENES[scene], seed)
    np.testing.assert_allclose(many.state[0], one.state, atol=1e-5)
    np.testing.assert_allclose(batched.object_positions()[0], simulation.object_position, atol=1e-5)
    assert many.reward[0] == pytest.approx(one.reward, abs=1e-4)
    assert many.images["third_view"].shape == (1, 64, 64, 3)
    difference = np.abs(many.images["third_view"][0].numpy().astype(int) - one.images["third_view"])
    assert difference.mean() < 0.5


def test_a_push_goes_the_same_way(batched: BatchedSimulation, simulation: Simulation) -> None:
    batched.task = simulation.task = TASKS["push"]
    batched.reset([SCENES[2]], [2], [0])
    simulation.reset(SCENES[2], 2)
    for _ in range(STEPS):
        aim = simulation.object_position + np.array([0.05, 0.0, -0.01]) - simulation.tcp_position
        action = np.array([*aim, 0.0, 0.0, 0.0, -1.0], np.float32)
        one, many = simulation.step(action), batched.step(torch.from_numpy(action)[None])
    np.testing.assert_allclose(many.state[0], one.state, atol=2e-3)
    np.testing.assert_allclose(batched.object_positions()[0], simulation.object_position, atol=5e-3)
    assert bool(many.success[0]) == one.success
