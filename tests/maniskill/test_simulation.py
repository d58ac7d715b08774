"""What the simulator does with a seed, a scene and an action."""

from pathlib import Path

import numpy as np
import pytest
import sapien
from lerobot.utils.constants import HF_LEROBOT_HOME
from mani_skill.render import PREBUILT_SHADER_CONFIGS
from transforms3d.quaternions import qconjugate, qmult, quat2axangle

from lerobot_wmrl.maniskill import backend, rendering, shaders
from lerobot_wmrl.maniskill.cameras import IMAGE_SIZE, ROBOT_MESH_DETAIL, VIEWS, Rendering
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH
from lerobot_wmrl.maniskill.episode import WORKSPACE_FLOOR, Frame
from lerobot_wmrl.maniskill.scenes import SCENES
from lerobot_wmrl.maniskill.simulation import Simulation
from lerobot_wmrl.maniskill.tasks import Push

CLOSED = -1.0


def command(axis: int, size: float) -> np.ndarray:
    action = np.zeros(7, np.float32)
    action[axis], action[6] = size, CLOSED
    return action


def test_the_same_seed_gives_the_same_start_and_the_same_future(simulation: Simulation) -> None:
    frames = []
    for seed in (3, 4, 3):  # another episode in between leaves no trace
        first = simulation.reset(SCENES[0], seed)
        for _ in range(3):
            last = simulation.step(command(0, 0.05))
        frames.append((first, last))
    for before, after in zip(frames[0], frames[2], strict=True):
        assert np.array_equal(before.images["third_view"], after.images["third_view"])
        np.testing.assert_allclose(before.state, after.state, atol=1e-5)
    assert not np.array_equal(frames[0][0].images["third_view"], frames[1][0].images["third_view"])


def test_the_gripper_starts_where_the_task_says_closed_and_pointing_down(simulation: Simulation) -> None:
    frame = simulation.reset(SCENES[1], 11)
    np.testing.assert_allclose(frame.state[:3], simulation.current_start.tcp, atol=2e-3)
    np.testing.assert_allclose(np.abs(frame.state[3:7]), [0, 1, 0, 0], atol=2e-3)
    assert frame.state[7] < 0.05


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_translation_moves_the_gripper_along_that_base_axis(
    simulation: Simulation, axis: int, sign: float
) -> None:
    before = simulation.reset(SCENES[0], 0).state
    for _ in range(2):
        after = simulation.step(command(axis, 0.03 * sign)).state
    moved = after[:3] - before[:3]
    assert sign * moved[axis] > 0.008
    assert np.abs(np.delete(moved, axis)).max() < 0.3 * abs(moved[axis])


def test_the_gripper_stops_above_the_table(simulation: Simulation) -> None:
    """However hard it is pushed down, so that the fingertips never scrape."""
    simulation.reset(SCENES[0], 0)
    heights = [simulation.step(command(2, -0.05)).state[2] for _ in range(20)]
    assert min(heights) > WORKSPACE_FLOOR - 0.002
    assert heights[-1] < WORKSPACE_FLOOR + 0.004


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_rotation_turns_the_gripper_about_that_base_axis(
    simulation: Simulation, axis: int, sign: float
) -> None:
    before = simulation.reset(SCENES[0], 0).state
    for _ in range(3):
        after = simulation.step(command(3 + axis, 0.2 * sign)).state
    turned, angle = quat2axangle(qmult(after[3:7], qconjugate(before[3:7])))
    rotation = turned * angle
    assert sign * rotation[axis] > 0.05
    assert np.abs(np.delete(rotation, axis)).max() < 0.3 * abs(rotation[axis])


def test_a_rotation_goes_on_beyond_half_a_turn(simulation: Simulation) -> None:
    """Actions say how far to turn, not where to: an angle that wraps would send the gripper back."""
    before, turned = simulation.reset(SCENES[0], 0).state, []
    for _ in range(52):
        after = simulation.step(command(5, 0.2)).state
        axis, angle = quat2axangle(qmult(after[3:7], qconjugate(before[3:7])))
        turned.append((axis[2] * angle + np.pi) % (2 * np.pi) - np.pi)
        before = after
    assert min(turned) > 0.02
    assert sum(turned) > np.pi + 0.1


def test_actions_are_clipped_to_the_box(simulation: Simulation) -> None:
    states = []
    for size in (ACTION_HIGH[0], 10.0):
        simulation.reset(SCENES[0], 0)
        states.append(simulation.step(command(0, size)).state)
    np.testing.assert_allclose(states[0], states[1], atol=1e-6)


def test_an_action_that_is_no_number_is_refused(simulation: Simulation) -> None:
    simulation.reset(SCENES[0], 0)
    with pytest.raises(ValueError, match=r"action: NaN in .*nothing can be simulated after it"):
        simulation.step(np.full(7, np.nan, np.float32))


def test_pushing_by_hand_succeeds_and_passing_above_does_not(simulation: Simulation) -> None:
    outcomes = []
    for height in (0.02, 0.12):
        simulation.reset(SCENES[2], 2)
        x, y, _ = simulation.object_position
        for target in ((x - 0.07, y, height), (x + 0.09, y, height)):
            for _ in range(25):
                delta = np.clip(2.0 * (np.array(target) - simulation.tcp_position), -0.05, 0.05)
                frame = simulation.step(np.array([*delta, 0, 0, 0, CLOSED]))
        outcomes.append(frame.success)
    assert outcomes == [True, False]


def test_every_scene_looks_different_and_only_its_object_is_on_the_table(simulation: Simulation) -> None:
    pictures = []
    for scene in SCENES:
        frame = simulation.reset(scene, 1)
        pictures.append(frame.images["third_view"].astype(int))
        on_table = [n for n, actor in simulation.env.objects.items() if actor._objs[0].pose.p[0] > -1.0]
        assert on_table == [scene.object]
    for first in range(len(SCENES)):
        for second in range(first):
            assert np.abs(pictures[first] - pictures[second]).mean() > 0.5


def test_shaders_without_the_table_draw_the_same_pictures(
    simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert Path(shaders.sensor_shaders().shader_pack).is_relative_to(HF_LEROBOT_HOME)
    rewritten = simulation.reset(SCENES[2], 5)
    monkeypatch.setattr(rendering, "sensor_shaders", lambda: PREBUILT_SHADER_CONFIGS[shaders.PACK])
    original = Simulation(simulation.task, SCENES[:3], simulation.rendering)
    expected = original.reset(SCENES[2], 5)
    original.close()
    for camera, image in rewritten.images.items():
        assert np.array_equal(image, expected.images[camera])


@pytest.mark.parametrize(
    "files",
    [
        {},
        {"minimal/a.frag": b"void main() {}"},
        {"minimal/a.frag": b"\xff"},
        {"minimal/a.frag": b"int samplerBRDFLUT;"},
    ],
)
def test_shaders_of_another_sapien_are_taken_as_they_are(files: dict[str, bytes], tmp_path: Path) -> None:
    for name, content in {"common/b.glsl": b"", **files}.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    assert shaders.rewritten(tmp_path) is None


def test_what_does_not_read_the_table_is_not_changed() -> None:
    assert shaders.without_table("vec4 color = texture(samplerColor, uv);") == (
        "vec4 color = texture(samplerColor, uv);"
    )


def test_files_are_written_by_whoever_is_first(tmp_path: Path) -> None:
    folder = tmp_path / "shaders" / "0123"
    for text in ("first", "second"):
        shaders.write_once(folder, {"minimal/a.frag": text})
    assert (folder / "minimal" / "a.frag").read_text() == "first"
    assert [path.name for path in folder.parent.iterdir()] == ["0123"]


def test_a_lighter_robot_looks_like_the_full_one_and_is_what_is_drawn() -> None:
    pictures = []
    for detail in (ROBOT_MESH_DETAIL, 1.0):
        simulation = Simulation(Push(), SCENES[:1], Rendering(robot_mesh_detail=detail))
        try:
            pictures.append(simulation.reset(SCENES[0], 0).images["third_view"].astype(int))
            bodies = [link._objs[0].entity for link in simulation.env.agent.robot.links]
        finally:
            simulation.close()
        drawn = [entity.find_component_by_type(sapien.render.RenderBodyComponent) for entity in bodies]
        assert all(body.is_enabled for body in drawn if body is not None)
    assert pictures[0].shape == (IMAGE_SIZE, IMAGE_SIZE, 3)
    assert np.abs(pictures[0] - pictures[1]).mean() < 6.0


def test_without_a_device_the_error_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    import sapien

    def no_device(name: str) -> None:
        raise RuntimeError(f"{name}: none here")

    monkeypatch.setattr(sapien, "Device", no_device)
    monkeypatch.setattr(sapien.render, "get_device_summary", lambda: "")
    with pytest.raises(backend.NoRendererError, match="make setup"):
        backend.render_backend()


def rendered(rendering: Rendering, seed: int) -> Frame:
    """The first frame of that episode. (A simulation of its own)"""
    simulation = Simulation(Push(), SCENES[:1], rendering)
    try:
        return simulation.reset(SCENES[0], seed)
    finally:
        simulation.close()


def test_depth_is_what_the_camera_is_away(simulation: Simulation) -> None:
    frame = rendered(Rendering(image_size=64, depth=True), 0)
    depth = frame.depth["third_view"]
    assert depth.shape == (64, 64, 1)
    assert depth.dtype == np.uint16
    view = VIEWS["third_view"]
    away = np.linalg.norm(np.subtract(view.eye, view.target))
    assert 0.6 * away < depth[32, 32, 0] / 1000 < 1.1 * away
    assert not simulation.reset(SCENES[0], 0).depth
