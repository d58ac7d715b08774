"""A user's mesh in place of an object: as big as it is, called what it is called, or refused with reasons."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.maniskill.objects import read_assets
from lerobot_wmrl.maniskill.scenes import SCENES


@pytest.fixture
def assets(tmp_path: Path) -> Path:
    """A file that replaces the lemon by a capsule whose units are millimetres and whose origin is its end."""
    capsule = trimesh.creation.capsule(height=30.0, radius=20.0)
    capsule.apply_translation((100.0, 0.0, 0.0))
    capsule.export(tmp_path / "capsule.obj")
    (tmp_path / "assets.yaml").write_text("lemon: {mesh: capsule.obj, label: shiny capsule, scale: 0.001}\n")
    return tmp_path / "assets.yaml"


def test_a_mesh_takes_the_place_of_an_object(assets: Path) -> None:
    scene = next(scene for scene in SCENES if scene.object == "lemon" and scene.split == "ind")
    simulation = WmrlManiSkillEnv(scenes=[scene.index], assets=assets, image_size=64).create_simulation()
    try:
        simulation.reset(scene, 0)
        assert "shiny capsule" in simulation.instruction
        assert simulation.episode.scene.object_spec.half_size == pytest.approx((0.02, 0.02, 0.035), abs=1e-4)
        resting = [simulation.step(np.zeros(7)) for _ in range(10)]
        assert resting[-1].images["third_view"].std() > 5
        assert simulation.object_position[2] == pytest.approx(0.035, abs=0.005)
        np.testing.assert_allclose(simulation.object_position, simulation.episode.object_start, atol=0.01)
        beside = WmrlManiSkillEnv(scenes=[scene.index], image_size=64).create_simulation()
        beside.reset(scene, 0)
        assert "lemon" in beside.instruction, "an environment without the mesh is not changed by it"
        beside.close()
        simulation.reset(scene, 1)
        assert "shiny capsule" in simulation.instruction
    finally:
        simulation.close()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lemmon: {mesh: capsule.obj}", r"'lemmon' is unknown; did you mean lemon\?"),
        ("lemon: {mehs: capsule.obj}", r"key of lemon 'mehs' is unknown; did you mean mesh\?"),
        ("lemon: {mesh: nowhere.obj}", r"lemon.mesh=.*nowhere.obj cannot be loaded"),
        ("lemon: {mesh: capsule.obj}", r"more than the gripper gets around .* scale to at most 0\.00"),
        ("lemon: {mesh: capsule.obj, scale: 0.0001}", "too low to be pushed"),
        ("lemon: {label: lemon}", "lemon has no mesh"),
        ("lemon: {mesh: capsule.obj, scale: big}", r"lemon.scale='big' must be a number"),
        ("lemon: {mesh: capsule.obj, scale: 0.001, density: 0}", r"lemon.density=0 must be"),
        ("- lemon", "must hold lines like"),
        ("lemon: {mesh", "cannot be read"),
    ],
)
def test_what_cannot_be_used_is_named(assets: Path, text: str, message: str) -> None:
    assets.write_text(text)
    with pytest.raises(ValueError, match=rf"assets=.*{message}"):
        read_assets(assets)
