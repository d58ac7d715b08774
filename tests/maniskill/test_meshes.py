"""The formulas fill the sizes that planners and tasks count on."""

import numpy as np
import pytest

from lerobot_wmrl.maniskill.actors import container_mesh, object_mesh
from lerobot_wmrl.maniskill.objects import CONTAINERS, OBJECTS

ROUND = [name for name, spec in OBJECTS.items() if spec.shape in ("ellipsoid", "revolved")]


@pytest.mark.parametrize("name", ROUND)
def test_a_mesh_is_closed_and_as_large_as_its_spec_says(name: str) -> None:
    spec = OBJECTS[name]
    mesh = object_mesh(spec)
    assert mesh.is_watertight
    np.testing.assert_allclose(np.abs(mesh.bounds).max(0), spec.half_size, rtol=1e-6)
    assert -mesh.bounds[0, 2] == pytest.approx(spec.half_size[2], rel=1e-6)  # it stands on the table


@pytest.mark.parametrize("name", CONTAINERS)
def test_a_container_stands_on_the_table_and_is_open_above(name: str) -> None:
    spec = CONTAINERS[name]
    mesh = container_mesh(spec)
    assert mesh.bounds[0, 2] == pytest.approx(0.0)
    assert mesh.bounds[1, 2] == pytest.approx(spec.height)
    middle = mesh.vertices[np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1]) < 1e-6, 2]
    assert middle.max() < spec.height
