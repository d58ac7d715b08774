"""lerobot-wmrl-play: drive a world model in the browser.

    lerobot-wmrl-play --world_model.path=outputs/action_world_model --dataset.root=data/episodes
    lerobot-wmrl-play --world_model.path=outputs/action_world_model --dataset.repo_id=user/episodes \\
        --policy.path=outputs/policy
    lerobot-wmrl-play --world_model.path=outputs/action_world_model --real_env.type=wmrl_maniskill \\
        --real_env.task=push

It serves one page and prints its address. There you, a policy, the planner or a recorded episode act, in turn
if you like, and the world model answers with the next frame, its probability of success and its uncertainty.
You can go back to any frame and do something else. An environment given by `--real_env.type` takes the same
actions, and is shown beside.

What was driven can be saved, as episodes of a LeRobotDataset in `--output_dir`, from which policies and world
models learn like from any other.

    lerobot-wmrl-play --world_model.path=outputs/action_world_model --dataset.root=data/episodes \\
        --export=outputs/page

writes a page that needs no server, for any host of files. The world model runs in the visitor's browser, and
you and the recorded episodes act.

The page is served to this machine alone. With another `--host`, visitors need the token in the address that
is printed.
"""

import shlex
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig

from lerobot_wmrl.common.checkpoints import Checkpoint
from lerobot_wmrl.common.command_line import RunConfig, run_command
from lerobot_wmrl.common.constants import DONE_FRAMES, DONE_THRESHOLD
from lerobot_wmrl.common.errors import FieldError, renamed, require_at_least
from lerobot_wmrl.common.files import require_new, writing
from lerobot_wmrl.common.policies import check_weights, read_policy_config
from lerobot_wmrl.common.policy_checks import require_trained
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.play.checks import LAST_PORT, whole_number

if TYPE_CHECKING:
    from lerobot_wmrl.play.world import World


@dataclass
class PlayConfig(RunConfig):
    """Drive a world model in the browser.

    Needed are `--world_model.path`, and frames to begin in: `--dataset.root`, `--dataset.repo_id` or
    `--real_env.type`.

    Args:
        world_model: the action world model.
        text_world_model: a text world model, for goal frames and how similar the imagined ones are to them;
            may be left out.
        dataset: episodes in whose frames a drive can begin. The page numbers those that `dataset.episodes`
            chooses from 0 on.
        policy: a policy that can act, `--policy.path=…`.
        real_env: an environment that takes the same actions, and in whose resets a drive can begin. ManiSkill
            shows the world model's cameras.
        done_threshold: predicted success probability at which a frame counts as done.
        done_frames: consecutive done frames that make a success.
        end_at_success: end a drive when it succeeds; otherwise it goes on.
        episode_length: frames after which a drive ends.
        host: address at which the page is served.
        port: port at which the page is served; 0 for any that is free.
        device: device of the models; by default the best one of this machine.
        output_dir: folder of the dataset of saved episodes. If it holds some, more are added.
        export: write the page into this new folder, and serve nothing. The world model then runs in the
            visitor's browser. It needs `pip install ".[export]"` in the clone, and npm.
        export_starts: episodes of the dataset in whose first frames an exported page can begin.
    """

    path_fields: ClassVar[list[str]] = ["policy"]
    other_names: ClassVar[dict[str, str]] = {"model.path": "world_model.path"}

    world_model: Checkpoint = field(default_factory=Checkpoint)
    text_world_model: Checkpoint = field(default_factory=Checkpoint)
    dataset: ChosenEpisodes = field(default_factory=ChosenEpisodes)
    policy: PreTrainedConfig | None = None
    real_env: EnvConfig | None = None
    done_threshold: float = DONE_THRESHOLD
    done_frames: int = DONE_FRAMES
    end_at_success: bool = True
    episode_length: int = 1000
    host: str = "127.0.0.1"
    port: int = 8000
    device: str | None = None
    output_dir: Path = Path("outputs/driven")
    export: Path | None = None
    export_starts: int = 64

    def validate(self) -> None:
        """Read the policy's configuration. FieldError for a setting that cannot be."""
        path, settings = self.given["policy"]
        if path:
            self.policy = read_policy_config(path, settings)
            check_weights(self.policy)
        if self.policy is not None:
            require_trained(self.policy)
        if not self.world_model.path:
            raise FieldError("world_model.path", "", "is missing", "give the action world model to drive")
        if not self.dataset.given and self.real_env is None:
            raise FieldError(
                "dataset.root",
                "",
                "is missing: a drive begins in a frame",
                "give the world model's dataset, `dataset.repo_id`, or an environment, `real_env.type`",
            )
        whole_number("port", self.port, LAST_PORT)
        require_at_least(self, 1, "export_starts")
        if self.export is not None:
            self._check_export(self.export)

    def _check_export(self, folder: Path) -> None:
        """FieldError if no page can be exported, or something is given that it would not have."""
        if not self.dataset.given:
            raise FieldError(
                "dataset.root", "", "is missing: an exported page begins in its frames", "give a dataset"
            )
        for name, value in (
            ("policy.path", self.policy),
            ("real_env.type", self.real_env),
            ("text_world_model.path", self.text_world_model.path),
        ):
            if value:
                raise FieldError(
                    name, getattr(value, "type", value), "is in no exported page", "leave it out"
                )
        require_new("export", folder)
        for package in ("onnx", "onnxscript", "onnxruntime"):
            if find_spec(package) is None:
                raise FieldError(
                    "export",
                    folder,
                    f"needs the package {package}",
                    'pip install ".[export]" in the clone of lerobot_wmrl',
                )


def play(cfg: PlayConfig) -> None:
    """Load the models and serve the page until interrupted."""
    from lerobot_wmrl.envs.configuration_world_model import DrivenEnv
    from lerobot_wmrl.play.saving import SavedEpisodes
    from lerobot_wmrl.play.server import PlayServer
    from lerobot_wmrl.play.web import serve
    from lerobot_wmrl.play.world import load_world

    cfg.validate()
    with (
        renamed("world_model_path", "world_model.path"),
        renamed("text_world_model_path", "text_world_model.path"),
    ):
        env = DrivenEnv(
            world_model_path=cfg.world_model.path,
            text_world_model_path=cfg.text_world_model.path,
            episode_length=cfg.episode_length,
            done_threshold=cfg.done_threshold,
            done_frames=cfg.done_frames,
            device=cfg.device if cfg.export is None else "cpu",
        )
        world = load_world(env, cfg.dataset, cfg.policy, cfg.real_env, cfg.end_at_success)
    if cfg.export is not None:
        export(world, cfg.export, cfg.export_starts)
        return
    saved = SavedEpisodes(cfg.output_dir, world.model.embodiment, cfg.done_frames)
    server = PlayServer(world, saved, cfg.host)
    try:
        with suppress(KeyboardInterrupt):
            serve(server.application(), server.access, cfg.port, "Ctrl-C ends it")
    finally:
        if saved.count:
            print(f"\n{saved.count} episodes are in {cfg.output_dir}")


def export(world: "World", folder: Path, starts: int) -> None:
    """Write the page that needs no server, and say how to look at it."""
    from lerobot_wmrl.play.export import export_page

    print("exporting the networks, which takes a minute or two", flush=True)
    with writing("export", folder, resumes=False):
        agreement = export_page(world, folder, starts)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    print(f"{folder}: {size / 1e6:.1f} MB; {agreement}")
    print(f"look at it: python -m http.server --directory {shlex.quote(str(folder))} --bind 127.0.0.1")


def main() -> None:
    """Run the console command."""
    run_command(play, PlayConfig, list)


if __name__ == "__main__":
    main()
