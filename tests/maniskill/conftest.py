"""One simulator for the tests of this package: building it costs seconds."""

from collections.abc import Iterator

import pytest

from lerobot_wmrl.maniskill.cameras import Rendering
from lerobot_wmrl.maniskill.scenes import SCENES
from lerobot_wmrl.maniskill.simulation import Simulation
from lerobot_wmrl.maniskill.tasks import Push


@pytest.fixture(scope="session")
def simulation() -> Iterator[Simulation]:
    simulation = Simulation(Push(), SCENES, Rendering(image_size=64))
    yield simulation
    simulation.close()
