"""Configuration of what runs between iterations: `--selection.*`, `--gate.*`, `--dyna.*`, `--real_env.*`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from lerobot.envs.configs import EnvConfig

from lerobot_wmrl.common.errors import FieldError, require_at_least, require_choice, require_share, within
from lerobot_wmrl.common.seeds import DYNA_SEEDS
from lerobot_wmrl.data.dataset import DatasetSource
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv

GATE_ACTIONS: Final = ("stop", "warn", "off")


@dataclass
class SelectionConfig:
    """Choice of the best checkpoint, `checkpoints/best`.

    Args:
        freq: iterations between two measurements of success. Each one also saves a checkpoint. 0: off.
        n_episodes: episodes in a measurement, always from the same starts. They run in `real_env` if it is
            set, so many of each task, from starts that are used neither for training nor for evaluation;
            otherwise in the world model, from as many starts in `dataset` or, if there are fewer, from all.
        dataset: dataset in whose episodes the imagined ones begin; by default `env.dataset`.
    """

    freq: int = 0
    n_episodes: int = 50
    dataset: DatasetSource = field(default_factory=DatasetSource)


@dataclass
class GateConfig:
    """Check that the world model does not call too many failures successes.

    Args:
        action: what happens above `limit`: `stop` the training or `warn`. `off`: there is no check.
        limit: largest false positive rate: the share of failed episodes that the world model predicts as
            successes.
        dataset: labelled rollouts that the world model was not trained on. The gate replays them before the
            first update and after each Dyna round.
        freq: iterations between two checks on new rollouts in `real_env`. There is always one before the
            first update and after each Dyna round; 0: no others.
        n_episodes: rollouts in each check in `real_env`.
    """

    action: str = "stop"
    limit: float = 0.05
    dataset: DatasetSource = field(default_factory=DatasetSource)
    freq: int = 10
    n_episodes: int = 50

    def __post_init__(self) -> None:
        if self.action == str(False):  # what YAML, which reads the flags, makes of `off`
            self.action = "off"


@dataclass
class NewRollouts:
    """Datasets of the policy that were recorded elsewhere.

    Args:
        roots: folders of LeRobotDatasets, one for each round; begin with []. Where the next one is missing,
            the training stops and names the policy to record. Add the recording's folder and run the command
            again to continue.
    """

    roots: list[str] | None = None


@dataclass
class DynaConfig:
    """Rounds that train the world model further on new rollouts of the current policy (Sutton 1991).

    Args:
        rounds: number of rounds, evenly spread over the iterations. 0: off.
        n_episodes: rollouts of the current policy recorded in `real_env` in each round, half of them with
            noise on the actions.
        dataset: datasets recorded elsewhere, for example on a robot, in place of `real_env`.
        learnt: dataset that the world model was trained on, which is mixed in so that it is not forgotten; by
            default `env.dataset`.
        steps: training steps of the world model in each round, half on old and half on new episodes.
        batch_size: clips in a training step of the world model.
    """

    rounds: int = 0
    n_episodes: int = 100
    dataset: NewRollouts = field(default_factory=NewRollouts)
    learnt: DatasetSource = field(default_factory=DatasetSource)
    steps: int = 1000
    batch_size: int = 16


@dataclass
class CallbackSettings:
    """What runs between iterations, `real_env`, the environment outside the world model, and the budget of
    real episodes."""

    budget: Path | None = None
    real_env: EnvConfig | None = None
    real_num_envs: int = 2
    selection: SelectionConfig = field(default_factory=SelectionConfig)
    gate: GateConfig = field(default_factory=GateConfig)
    dyna: DynaConfig = field(default_factory=DynaConfig)

    def check_callbacks(self, env: EnvConfig, iterations: int) -> None:
        """Raise FieldError for the first setting that does not fit a training in `env`."""
        require_at_least(self, 1, "real_num_envs")
        self._check_selection_and_gate()
        if not isinstance(env, WorldModelEnv):
            self._refuse_datasets(env)
        elif self.gate.action == "stop":
            self._check_gate_has_labels()
        self._check_dyna_sizes(iterations)
        if self.dyna.rounds:
            self._check_dyna(env)
        if self.budget is not None and self.selection.freq:
            self._check_selection_is_imagined(env)

    def learnt(self, env: EnvConfig) -> DatasetSource:
        """Return the dataset that the world model was trained on."""
        source = self.dyna.learnt
        return source if source.given or not isinstance(env, WorldModelEnv) else env.dataset

    def _check_selection_and_gate(self) -> None:
        with within("selection"):
            require_at_least(self.selection, 0, "freq")
            require_at_least(self.selection, 1, "n_episodes")
        with within("gate"):
            require_choice(self.gate, "action", GATE_ACTIONS)
            require_share(self.gate, "limit")
            require_at_least(self.gate, 0, "freq")
            require_at_least(self.gate, 1, "n_episodes")

    def _check_selection_is_imagined(self, env: EnvConfig) -> None:
        if self.real_env is not None or not isinstance(env, WorldModelEnv):
            raise FieldError(
                "selection.freq",
                self.selection.freq,
                "under a budget, selection must be in a world model: its episodes in the simulator would be "
                "counted nowhere",
                "leave out `real_env.type`, or `selection.freq`",
            )

    def _refuse_datasets(self, env: EnvConfig) -> None:
        """Raise FieldError for a dataset that nothing reads outside a world model."""
        for name, source in (("gate", self.gate.dataset), ("selection", self.selection.dataset)):
            if source.given:
                raise FieldError(
                    f"{name}.dataset.root",
                    source.name,
                    f"is read in a world model alone, and `env.type` is {env.type}",
                    "leave it out",
                )

    def _check_gate_has_labels(self) -> None:
        if not self.gate.dataset.given and self.real_env is None:
            raise FieldError(
                "gate.action",
                self.gate.action,
                "no episode says what success is outside the world model, so its false positives cannot be "
                "counted",
                "give labelled rollouts (`gate.dataset.root`) or an environment to record some in "
                "(`real_env.type`), or train unchecked with `gate.action` warn",
            )

    def _check_dyna_sizes(self, iterations: int) -> None:
        dyna = self.dyna
        with within("dyna"):
            require_at_least(dyna, 0, "rounds")
            require_at_least(dyna, 2, "n_episodes")
            require_at_least(dyna, 1, "steps", "batch_size")
            if dyna.rounds >= iterations:
                raise FieldError(
                    "rounds", dyna.rounds, f"there is room for {iterations - 1}, one between two iterations"
                )
            if dyna.rounds * dyna.n_episodes >= DYNA_SEEDS:
                raise FieldError(
                    "n_episodes",
                    dyna.n_episodes,
                    f"there are fewer than {DYNA_SEEDS} for all rounds together",
                )

    def _check_dyna(self, env: EnvConfig) -> None:
        problem = remedy = None
        if not isinstance(env, WorldModelEnv):
            problem, remedy = "there is no world model to refresh", "choose `env.type` world_model"
        elif env.reward.type == "embedding":
            problem = (
                "an embedding reward reads the hidden state of one world model and means nothing to a "
                "refreshed one"
            )
            remedy = "choose `env.reward.type` general or proxy"
        elif self.real_env is None and self.dyna.dataset.roots is None:
            problem = "there are no new episodes to learn from"
            remedy = (
                "give an environment to record in (`real_env.type`), or datasets recorded elsewhere "
                "(`dyna.dataset.roots`)"
            )
        elif not self.learnt(env).given:
            problem = "the world model would forget what it was trained on"
            remedy = "give that dataset, `dyna.learnt.root`"
        if problem and remedy:
            raise FieldError("dyna.rounds", self.dyna.rounds, problem, remedy)
