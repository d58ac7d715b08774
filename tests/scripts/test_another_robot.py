"""The whole way with a robot that nobody here has built for: three joints in degrees, one camera, 30 Hz.

Its frames are no squares, and of another size than the world model's.
"""

from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import OBS_IMAGE

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.recorder import record
from lerobot_policy_wm_mpc.configuration_wm_mpc import WmMpcConfig
from lerobot_policy_wm_mpc.modeling_wm_mpc import WmMpcPolicy
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.envs.evaluation_adapter import EvaluationAdapter
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from tests.rl.checkpoints import save_untrained_policy
from tests.scripts.test_train import SHORT, improve
from tests.trained import action_config, run_training, tokenizer_config

JOINTS, FPS, FRAMES = ["shoulder.pos", "elbow.pos", "gripper.pos"], 30, 12
HEIGHT, WIDTH, SIDE = 36, 48, 32
LOW, HIGH = [-90.0, 10.0, 0.0], [90.0, 60.0, 100.0]


@pytest.fixture(scope="module")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six episodes recorded with LeRobot's own functions; every second one succeeds at its end."""
    root, rng = tmp_path_factory.mktemp("joints") / "episodes", np.random.default_rng(0)
    joints = {"dtype": "float32", "shape": (3,), "names": JOINTS}
    features = {
        "action": joints,
        "observation.state": joints,
        OBS_IMAGE: {
            "dtype": "image",
            "shape": (HEIGHT, WIDTH, 3),
            "names": ["height", "width", "channels"],
        },
        "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    }
    dataset = LeRobotDataset.create("local/joints", FPS, features, root=root, use_videos=False)
    for episode in range(6):
        for frame in range(FRAMES):
            share = np.array([frame / (FRAMES - 1), 1 - frame / (FRAMES - 1), episode % 2])
            angles = (LOW + share * np.subtract(HIGH, LOW)).astype(np.float32)
            dataset.add_frame(
                {
                    "action": angles,
                    "observation.state": angles,
                    "task": "reach",
                    OBS_IMAGE: rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8),
                    "next.success": np.array([bool(episode % 2) and frame >= FRAMES - 3]),
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return root


@pytest.fixture(scope="module")
def world_model(episodes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("joints_models")
    tokenizer = run_training(
        tokenizer_config(cameras=[OBS_IMAGE], image_size=SIDE), episodes, folder / "tokenizer"
    )
    return run_training(action_config(tokenizer), episodes, folder / "world_model")


def imagination(world_model: Path, episodes: Path) -> list[str]:
    return [
        "--env.type=world_model",
        f"--env.world_model_path={world_model}",
        f"--env.dataset.root={episodes}",
        "--env.episode_length=6",
        "--env.reward.type=general",
        "--gate.action=off",
    ]


def test_the_environment_is_that_robot(world_model: Path, episodes: Path) -> None:
    config = WorldModelEnv(
        world_model_path=str(world_model),
        dataset=StartFrames(root=str(episodes)),
        episode_length=6,
        reward=GeneralConfig(alpha=1.0),
    )
    env = config.create_tensor_env(2)
    assert (config.fps, env.metadata["render_fps"]) == (FPS, FPS)
    np.testing.assert_allclose(env.single_action_space.low, LOW)
    np.testing.assert_allclose(env.single_action_space.high, HIGH)
    assert env.model.config.embodiment.action_names == JOINTS
    assert EvaluationAdapter(env).reset(seed=0)[0]["pixels"].shape == (2, HEIGHT, WIDTH, 3)
    assert env.model.tokenizer.image_size == SIDE
    info = env.step(torch.tensor([LOW, [*HIGH[:2], 101.0]]))[-1]
    assert info["reward_parts"]["clipped"].tolist() == pytest.approx([0, 1 / 3])


def test_its_policy_is_improved_in_imagination(
    world_model: Path, episodes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = save_untrained_policy(tmp_path / "policy", camera=OBS_IMAGE, size=(HEIGHT, WIDTH), constant=30.0)
    flags = [f"--policy.path={policy}", *SHORT, *imagination(world_model, episodes)]
    improve(monkeypatch, *flags, f"--output_dir={tmp_path / 'rl'}")
    line = read_metrics(tmp_path / "rl")[-1]
    assert line["clipped"] == 0


def test_a_policy_in_other_units_is_refused(
    world_model: Path,
    episodes: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    policy = save_untrained_policy(
        tmp_path / "policy", camera=OBS_IMAGE, size=(HEIGHT, WIDTH), constant=5000.0
    )
    flags = [f"--policy.path={policy}", *SHORT, *imagination(world_model, episodes)]
    with pytest.raises(SystemExit):
        improve(monkeypatch, *flags, f"--output_dir={tmp_path / 'rl'}")
    assert (
        "shoulder.pos is 5000 on average, in the environment it is between -90 and 90"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize(("threshold", "frames", "successes"), [(0.9999, 6, 0), (0.0001, 2, 3)])
def test_its_imagined_episodes_are_recorded(
    threshold: float, frames: int, successes: int, world_model: Path, episodes: Path, tmp_path: Path
) -> None:
    """Success is marked in the frames that made it, the last two."""
    env = WorldModelEnv(
        world_model_path=str(world_model),
        dataset=StartFrames(root=str(episodes)),
        episode_length=6,
        reward=GeneralConfig(alpha=1.0),
        done_threshold=threshold,
        done_frames=2,
    )
    policy = save_untrained_policy(tmp_path / "policy", OBS_IMAGE, size=(HEIGHT, WIDTH), constant=30.0)
    record(
        RecordConfig(
            output_dir=tmp_path / "imagined",
            env=env,
            num_episodes=3,
            part_episodes=2,
            exploration=0.1,
            policy=read_policy_config(str(policy), []),
            video=False,
        )
    )
    table = read_episodes(open_dataset(tmp_path / "imagined"))
    features = table.dataset.features
    assert (table.dataset.fps, features["action"]["names"]) == (FPS, JOINTS)
    np.testing.assert_allclose([features["action"]["info"][end] for end in ("low", "high")], [LOW, HIGH])
    assert tuple(features[OBS_IMAGE]["shape"]) == (HEIGHT, WIDTH, 3)
    assert table.length.tolist() == [frames] * 3
    assert table.success.sum() == successes
    assert table.done.sum() == 2 * successes


def test_it_can_be_planned_for(world_model: Path) -> None:
    config = WmMpcConfig(
        world_model_path=str(world_model),
        horizon=6,
        execute=2,
        samples=4,
        elites=2,
        iterations=1,
        knots=2,
        device="cpu",
    )
    image = torch.rand(2, 3, HEIGHT, WIDTH)
    state = torch.tensor([LOW, HIGH])
    planner = WmMpcPolicy(config)
    action = planner.select_action({OBS_IMAGE: image, "observation.state": state})
    assert action.shape == (2, 3)
    assert ((action >= torch.tensor(LOW)) & (action <= torch.tensor(HIGH))).all()
