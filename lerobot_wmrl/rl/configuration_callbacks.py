"""Configuration of what is done between iterations: `--selection.*`, `--gate.*`, `--dyna.*`."""

from dataclasses import dataclass, field
from typing import Final

from lerobot.envs.configs import EnvConfig

from lerobot_wmrl.data.dataset_source import DatasetSource
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv

GATE_ACTIONS: Final = ("stop", "warn", "off")

DYNA_SEEDS: Final = 100_000
"""The last so many below EVALUATION_SEED: what a world model learns from is not evaluated on."""


@dataclass
class SelectionConfig:
    """Which checkpoint is the best, `checkpoints/best`.

    Args:
        freq: iterations between two measurements of success, which also save a checkpoint; 0 is off.
        n_episodes: of each, always the same ones, neither trained on nor evaluated on; in `real_env` if
            there is one, else imagined ones alone decide.
        dataset: whose first frames the imagined episodes begin with; by default those that the training
            begins with.
    """

    freq: int = 0
    n_episodes: int = 50
    dataset: DatasetSource = field(default_factory=DatasetSource)

    def check(self) -> None:
        """ValueError names the setting that cannot be."""
        _at_least(0, "selection.freq", self.freq)
        _at_least(1, "selection.n_episodes", self.n_episodes)


@dataclass
class GateConfig:
    """May a policy be trained in this world model? Not if it calls real failures successes.

    Args:
        action: `stop` when more failures than `limit` are believed, `warn` of it, or `off`.
        limit: largest share of real failures that the world model may call successes.
        dataset: real rollouts with success labels, that the world model was not trained on; it is asked about
            them before the first update and after each Dyna round.
        freq: iterations from one batch of fresh rollouts in `real_env` to the next; there are some before the
            first update too. 0: only then.
        n_episodes: of each batch of fresh
            rollouts.
    """

    action: str = "stop"
    limit: float = 0.05
    dataset: DatasetSource = field(default_factory=DatasetSource)
    freq: int = 10
    n_episodes: int = 50

    def __post_init__(self) -> None:
        if self.action == str(False):  # what YAML, which reads the flags, makes of `off`
            self.action = "off"

    def check(self) -> None:
        """ValueError names the setting that cannot be."""
        if self.action not in GATE_ACTIONS:
            raise ValueError(f"--gate.action={self.action}: choose one of {', '.join(GATE_ACTIONS)}")
        if not 0 <= self.limit <= 1:
            raise ValueError(f"--gate.limit={self.limit}: must be a share, from 0 to 1")
        _at_least(0, "gate.freq", self.freq)
        _at_least(1, "gate.n_episodes", self.n_episodes)


@dataclass
class NewRollouts:
    """What was recorded elsewhere.

    Args:
        roots: LeRobotDatasets, one for each round. The training stops where one is missing and says which
            policy to record; the same command with one more goes on. Begin with [].
    """

    roots: list[str] | None = None


@dataclass
class DynaConfig:
    """Rounds in which the world model learns what the policy does by now (Sutton 1991).

    Args:
        rounds: how many, evenly spread over the iterations; 0 is off.
        n_episodes: of the policy recorded in `real_env` each round, half of them noisy by noise.
        dataset: recorded elsewhere instead (on a real robot, say).
        learnt: what the world model has been trained on so far and is not to forget; by default the
            dataset of `env`.
        steps, batch_size, learning_rate: of each round's training on old and new episodes, half and half, by
            lerobot-wmrl-train-world-model.
    """

    rounds: int = 0
    n_episodes: int = 100
    dataset: NewRollouts = field(default_factory=NewRollouts)
    learnt: DatasetSource = field(default_factory=DatasetSource)
    steps: int = 1000
    batch_size: int = 16
    learning_rate: float = 3e-4

    def check(self, iterations: int) -> None:
        """ValueError names the setting that cannot be."""
        for least, name in ((0, "rounds"), (2, "n_episodes"), (1, "steps"), (1, "batch_size")):
            _at_least(least, f"dyna.{name}", getattr(self, name))
        if self.rounds >= iterations:
            raise ValueError(
                f"--dyna.rounds={self.rounds}: there is room for {iterations - 1}, one between two iterations"
            )
        if self.rounds * self.n_episodes > DYNA_SEEDS:
            raise ValueError(
                f"--dyna.n_episodes={self.n_episodes}: at most {DYNA_SEEDS} episodes in all rounds together"
            )
        if self.learning_rate <= 0:
            raise ValueError(f"--dyna.learning_rate={self.learning_rate}: must be above 0")


@dataclass
class CallbackSettings:
    """What is done between iterations; and `real_env`, the reality it is done in."""

    real_env: EnvConfig | None = None
    real_num_envs: int = 2
    selection: SelectionConfig = field(default_factory=SelectionConfig)
    gate: GateConfig = field(default_factory=GateConfig)
    dyna: DynaConfig = field(default_factory=DynaConfig)

    def check_callbacks(self, env: EnvConfig, iterations: int) -> None:
        """ValueError names the setting that cannot be, of a training in `env`."""
        _at_least(1, "real_num_envs", self.real_num_envs)
        self.selection.check()
        self.gate.check()
        self.dyna.check(iterations)
        if self.dyna.rounds:
            self._check_dyna(env)
        asked = self.gate.dataset.root or self.simulator
        if isinstance(env, WorldModelEnv) and self.gate.action == "stop" and not asked:
            raise ValueError(
                "--gate.action=stop: nothing says what is real, so whether this world model calls failures "
                "successes cannot be known; give labelled rollouts (--gate.dataset.root) or a simulator "
                "(--real_env.type=wmrl_maniskill), or train unchecked with --gate.action=warn"
            )

    @property
    def simulator(self) -> WmrlManiSkillEnv | None:
        """Where lerobot-wmrl-record can record."""
        return self.real_env if isinstance(self.real_env, WmrlManiSkillEnv) else None

    def learnt(self, env: EnvConfig) -> DatasetSource:
        """The dataset that the world model has learnt from."""
        own = self.dyna.learnt
        return own if own.root or not isinstance(env, WorldModelEnv) else env.dataset

    def _check_dyna(self, env: EnvConfig) -> None:
        where = f"--dyna.rounds={self.dyna.rounds}"
        if not isinstance(env, WorldModelEnv):
            raise ValueError(f"{where}: there is no world model to refresh in --env.type={env.type}")
        if env.reward.type == "embedding":
            raise ValueError(
                f"{where}: an embedding reward reads the hidden state of one world model and means nothing "
                "to a refreshed one; choose --env.reward.type=general or proxy"
            )
        if self.simulator is None and self.dyna.dataset.roots is None:
            raise ValueError(
                f"{where}: give a simulator to record in (--real_env.type=wmrl_maniskill), or datasets "
                "recorded elsewhere (--dyna.dataset.roots)"
            )
        if not self.learnt(env).root:
            raise ValueError(
                f"{where}: give the dataset that the world model has learnt from, --dyna.learnt.root, for it "
                "is not to forget it"
            )


def _at_least(least: int, name: str, value: int) -> None:
    """ValueError below."""
    if value < least:
        raise ValueError(f"--{name}={value}: must be at least {least}")
