"""Configuration of lerobot-wmrl-train."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar

import draccus
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.default import PeftConfig, WandBConfig
from lerobot.envs.configs import EnvConfig
from lerobot.rl.algorithms.configs import RLAlgorithmConfig

from lerobot_wmrl.common.checkpoints import UNPUBLISHED
from lerobot_wmrl.common.command_line import RunConfig
from lerobot_wmrl.common.errors import FieldError, require_at_least, within
from lerobot_wmrl.common.hub import published_name
from lerobot_wmrl.common.output_folders import RUN_CONFIG_FILE
from lerobot_wmrl.common.policies import adapter_config, read_policy_config
from lerobot_wmrl.common.seeds import require_seed
from lerobot_wmrl.rl.configuration_algorithms import AlgorithmConfig, PPOConfig
from lerobot_wmrl.rl.configuration_callbacks import CallbackSettings

PUBLISHING = ("push_to_hub", "repo_id", "private", "license", "tags")
"""Settings of the policy that only matter when it is published."""

READ = ("input_features", "output_features", "use_peft", "pretrained_path")
"""Settings of the policy that its checkpoint alone knows: the training may fill them in."""

MAY_DIFFER = (
    "resume",
    "job_name",
    "log_freq",
    "wandb",
    "gate.action",
    "dyna.dataset",
    *(f"policy.{name}" for name in PUBLISHING),
)
"""Settings that may change when a run is resumed."""


@dataclass
class TrainConfig(CallbackSettings, RunConfig):
    """Train a policy further by reinforcement learning.

    `--preset=tiny|demo|cpu` stands for the flags of that size; flags further right override it.

    Args:
        policy: the SFT policy to improve, `--policy.path=FOLDER`: a checkpoint, or the output folder of
            lerobot-train. PPO and GRPO train `cnn`, `act` and `openvla`; distillation trains any policy that
            lerobot-train can clone.
        env: `--env.type=world_model`, `wmrl_maniskill` or one of LeRobot's, and its settings.
        algorithm: `--algorithm.type=ppo`, `grpo` or `distillation`, and its settings.
        peft: `--peft.method_type=LORA --peft.r=32`, as in lerobot-train, trains new adapters and the value
            function alone. A policy that has adapters already needs none of these flags.
        output_dir: folder of checkpoints and metrics. If it holds this run already, the run continues.
        num_envs: environments stepped together, in each process of `torchrun`.
        rollout_steps: steps of each environment in a rollout; by default the longest episode.
        iterations: number of rollouts, each followed by an update.
        save_freq: iterations between checkpoints.
        log_freq: iterations between lines in the terminal.
        seed: seed of sampling and of the episodes, below 1,000,000. Seeds from there on are for evaluation.
        resume: require a checkpoint in `output_dir` and continue from it, as in lerobot-train. Works with
            `--config_path=outputs/rl/train_config.json` in place of all other flags too. Without this flag
            the same command begins or continues.
        wandb: `--wandb.enable=true` sends the metrics to Weights & Biases too, as lerobot-train does.
        job_name: name of the run in Weights & Biases.
        budget: ledger of the real episodes that a method may learn from, a JSON file (docs/protocol.md). It
            must know the episodes of all datasets. Recordings in `real_env` are entered, and so are the steps
            of a training outside a world model, as rollouts. Selection in `real_env` is refused.
        real_env: any environment of LeRobot's, for selection, gate and Dyna: `--real_env.type=…` and its
            settings.
        real_num_envs: environments that run at once in `real_env`.
        selection: choice of the checkpoint that is kept as `checkpoints/best`; off by default.
        gate: check of the world model's false positive rate.
        dyna: rounds that train the world model further on new rollouts of the current policy; off by default.
    """

    path_fields: ClassVar[list[str]] = ["policy"]
    other_names: ClassVar[dict[str, str]] = {"steps": "iterations", "batch_size": "num_envs"}
    dataset: ClassVar[None] = None
    is_reward_model_training: ClassVar[bool] = False

    policy: PreTrainedConfig | None = None
    env: EnvConfig | None = None
    algorithm: RLAlgorithmConfig = field(default_factory=PPOConfig)
    peft: PeftConfig | None = None
    output_dir: Path = Path("outputs/rl")
    num_envs: int = 64
    rollout_steps: int | None = None
    iterations: int = 40
    save_freq: int = 5
    log_freq: int = 1
    seed: int = 0
    resume: bool = False
    wandb: WandBConfig = field(default_factory=WandBConfig)
    job_name: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration as the dictionary that LeRobot's WandBLogger asks for."""
        return draccus.encode(self)

    def validate(self) -> None:
        """Raise FieldError for the first setting that is impossible."""
        if not isinstance(self.algorithm, AlgorithmConfig):
            raise FieldError(
                "algorithm.type", self.algorithm.type, "this command trains with ppo, grpo or distillation"
            )
        if self.env is None:
            raise FieldError("env.type", None, "is missing", "choose world_model, or another environment")
        require_at_least(self, 1, "num_envs", "iterations", "save_freq", "log_freq")
        self.algorithm.check(self.num_envs, self.iterations, self.env)
        require_seed(self)
        self.check_callbacks(self.env, self.iterations)


def resolve_policy(cfg: TrainConfig) -> PreTrainedConfig:
    """Read the policy's configuration into `cfg` and return it.

    A run that is continued by its stored configuration has the policy's settings from there. Whether and
    where the policy is published never comes from the checkpoint, as it would overwrite the SFT policy.
    """
    (typed, overrides), stored = cfg.given["policy"], cfg.policy
    path = typed or (stored and stored.pretrained_path)
    if not path:
        raise ValueError("--policy.path: give the checkpoint of the policy to train")
    cfg.policy = read_policy_config(str(path), [*UNPUBLISHED, *overrides])
    if stored is not None:
        given = {each.removeprefix("--").partition("=")[0] for each in overrides}
        settings = [each.name for each in fields(stored) if each.name not in READ]
        stored_run = Path(parser.parse_arg("config_path") or "").name == RUN_CONFIG_FILE
        for name in settings if stored_run and not typed else PUBLISHING:
            if name not in given:
                setattr(cfg.policy, name, getattr(stored, name))
    if cfg.policy.push_to_hub and not cfg.policy.repo_id:
        raise FieldError("policy.push_to_hub", True, "give its name on the hub, --policy.repo_id=user/name")
    if cfg.policy.push_to_hub:
        from lerobot_wmrl.common.hub import check_login

        require_published_base(cfg, cfg.policy)
        with within("policy"):
            check_login()
    return cfg.policy


def require_published_base(cfg: TrainConfig, policy: PreTrainedConfig) -> None:
    """Raise FieldError if adapters are to be published and what they adapt is a folder of this machine."""
    base = policy.pretrained_path if cfg.peft is not None else None
    if policy.use_peft:
        base = adapter_config(policy).base_model_name_or_path
    if base is not None and published_name(base) is None:
        raise FieldError(
            "policy.push_to_hub",
            True,
            f"the adapters belong to the policy in {base}, which nobody else has",
            "publish that one, and give its name on the hub: with new adapters as `policy.path`, else in "
            "adapter_config.json, base_model_name_or_path",
        )
