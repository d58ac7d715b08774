"""What a judgement rests on: labelled rollouts, policies of known success, and where models come from."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from os.path import normpath
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from lerobot.utils.constants import CHECKPOINTS_DIR, PRETRAINED_MODEL_DIR

from lerobot_wmrl.common.checkpoints import model_folder
from lerobot_wmrl.common.constants import DYNA, START_SCENE
from lerobot_wmrl.common.errors import FieldError, first_line
from lerobot_wmrl.common.output_folders import RUN_CONFIG_FILE
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.data.dataset import DatasetSource, local_copies, open_dataset
from lerobot_wmrl.data.episodes import EpisodeTable, choose_episodes, read_episodes
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.evaluation.calibration import Confusion
from lerobot_wmrl.evaluation.gate import gate_at
from lerobot_wmrl.evaluation.outcomes import Outcomes, labelled_recording, predict_outcomes
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.maniskill.recordings import scene_splits
from lerobot_wmrl.world_models.checkpoint import load_model


@dataclass(frozen=True)
class LabelledRollouts:
    """Labelled rollouts that a world model is checked on.

    Args:
        name: of their dataset.
        table: all of its episodes.
        chosen: indices of those that are meant. (E,)
    """

    name: str
    table: EpisodeTable
    chosen: np.ndarray

    @classmethod
    def read(
        cls, source: DatasetSource, split: str = "all", episodes: Sequence[int] | None = None
    ) -> "LabelledRollouts":
        """Open a dataset and choose, of these episodes, those of a split. FieldError if it cannot be read."""
        table = read_episodes(source.open())
        scenes, among = scene_splits(table.column(START_SCENE), split), table.among(episodes)
        return cls(source.name, table, choose_episodes(table, split, len(table.length), scenes, among))

    @property
    def root(self) -> Path:
        """Folder of the dataset."""
        return Path(self.table.dataset.root)


def replayed_rollouts(env: WorldModelEnv, rollouts: LabelledRollouts) -> Outcomes:
    """Replay labelled rollouts in a world model, as long as an imagined episode lasts.

    Raises:
        FieldError: they do not fit the world model, have no labels, or do not both succeed and fail.
    """
    model = load_model(env.world_model_path, "action_world_model", env.device)
    recording = labelled_recording(model, rollouts.table)
    recording = Recording(rollouts.table.subset(rollouts.chosen), recording.frames)
    outcomes = predict_outcomes(model, recording).within(env.horizon)
    for matching, kind in ((outcomes.success, "succeeds"), (~outcomes.success, "fails")):
        if not matching.any():
            raise FieldError(
                "dataset.root",
                rollouts.name,
                f"none of the {len(matching)} rollouts {kind} within {env.horizon} frames, so nobody knows "
                "how often the world model errs",
                "give rollouts that both succeed and fail",
            )
    return outcomes


def confusion_of(outcomes: Outcomes, env: WorldModelEnv) -> tuple[Confusion, list[str]]:
    """Return the world model's confusion where the environment ends an episode, and what biases it."""
    gate = gate_at(outcomes, env.criterion)
    warnings = []
    short = int((outcomes.length[~outcomes.success] < env.horizon).sum())
    if short:
        warnings.append(
            f"{short} of {gate.false_positives.n} failures were recorded for fewer than the {env.horizon} "
            "frames of an imagined episode. A later false positive is not counted, so estimates may be too "
            "high: lower --episode_length."
        )
    if gate.cut_short and not gate.repeats_last:
        warnings.append(
            f"{gate.cut_short} of {gate.recall.n} successes end before success has held for "
            f"{env.done_frames} frames. They cannot be predicted, so estimates may be too high: lower "
            "--done_frames."
        )
    return Confusion(gate.recall, gate.false_positives), warnings


def pooled_instructions(rollouts: LabelledRollouts) -> list[str]:
    """Return a warning if the rollouts have several instructions, which may be of several tasks."""
    instructions = sorted({rollouts.table.instructions[episode] for episode in rollouts.chosen})
    if len(instructions) < 2:
        return []
    return [
        f"The rollouts have {len(instructions)} instructions ({instructions[0]!r}, {instructions[1]!r} …), "
        "over which successes and errors are averaged. If they are of different tasks, judge each by itself: "
        "choose its rollouts with --dataset.episodes."
    ]


def read_references(path: Path | None) -> dict[str, Proportion]:
    """Read real success of policies from a comparison, or from a file that is written like it.

    Raises:
        FieldError: there is none, it is something else, it is not finished or has stopped early, or its
            episodes are imagined.
    """
    if path is None:
        return {}
    try:
        results = json.loads(path.read_text())
        rates = {name: _rate(policy["k"], policy["n"]) for name, policy in results["policies"].items()}
        kind = (results.get("env") or {}).get("type")
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise FieldError(
            "references",
            path,
            f"no success of policies can be read from it ({first_line(error)})",
            "give comparison.json of lerobot-wmrl-compare, or a file like it: "
            '{"policies": {"outputs/a": {"k": 12, "n": 20}}}',
        ) from error
    if kind == WorldModelEnv.get_choice_name(WorldModelEnv):
        raise FieldError(
            "references", path, "its episodes are imagined ones", "compare the policies in a real environment"
        )
    if not results.get("finished", True):
        raise FieldError("references", path, "the comparison was interrupted", "run its command again")
    sequential = any(pair.get("test") == "sequential" for pair in results.get("pairs", []))
    if not results.get("complete", not sequential):
        early = "stopped early" if "complete" in results else "may have stopped early"
        raise FieldError(
            "references",
            path,
            f"the comparison {early}, and then the rates lean to the winner",
            "repeat it with --stop_early=false in another folder",
        )
    return rates


def _rate(k: Any, n: Any) -> Proportion:
    if not (isinstance(k, int) and isinstance(n, int) and 0 <= k <= n and n):
        raise ValueError(f"{k} of {n} is no number of successes and of episodes")
    return Proportion(k, n)


def trained_inside(policy: str, world_model: str) -> str | None:
    """Return why a policy is not judged in a world model: it was trained there, or plans there.

    Trainings are followed back as far as their settings lie on this machine. Any checkpoint of the training
    that made the world model counts, one that was trained further on new rollouts (Dyna) too.
    """
    ancestors = [training.checkpoint for training in _trainings(world_model, "model")]
    folders = Path(world_model).resolve().parents
    for training in _trainings(policy, "policy"):
        used = training.located((training.settings.get("env") or {}).get("world_model_path"))
        inside = training_folder(training.checkpoint) / DYNA in folders
        if used and (inside or any(same_training(used, each) for each in ancestors)):
            return (
                "it was trained in this world model, and may have learnt what only looks like success there"
            )
    planner = stored_settings(model_folder(policy) / "config.json").get("world_model_path")
    if planner and same_training(planner, world_model):
        return "it plans in this world model, and finds what only looks like success there"
    return None


def learnt_from(world_model: str, rollouts: LabelledRollouts) -> int:
    """Return how many of the rollouts the world model has learnt from, themselves or as copies.

    Trainings that it was continued from count too, and that of a tokenizer which tells success, as far as
    their settings and data lie on this machine.
    """
    learnt: list[tuple[str, Sequence[int] | None]] = []
    for training in _trainings(world_model, "model"):
        source = training.settings.get("dataset") or {}
        learnt += [(root, source.get("episodes")) for root in _folders(training, rollouts)]
        learnt += [(training.located(more), None) for more in source.get("more", ())]
    table, elsewhere = rollouts.table, set[str]()
    themselves = np.zeros(len(table.start), bool)
    for root, episodes in learnt:
        if _same(Path(root), rollouts.root):
            themselves |= table.training(episodes)
        else:
            elsewhere |= set(learnt_digests(Path(root), episodes))
    copied = [digest in elsewhere for digest in action_digests(table, rollouts.chosen)]
    return int((themselves[rollouts.chosen] | np.array(copied, bool)).sum())


def _folders(training: "Training", rollouts: LabelledRollouts) -> list[str]:
    """Return where the dataset that a training was given lies on this machine: where the rollouts do, if they
    have its name."""
    source = training.settings.get("dataset") or {}
    root, repo_id = source.get("root"), source.get("repo_id")
    if root or not repo_id:
        return [training.located(root)] if root else []
    return [str(rollouts.root)] if repo_id == rollouts.name else [str(path) for path in local_copies(repo_id)]


def learnt_digests(root: Path, episodes: Sequence[int] | None) -> list[str]:
    """Return `action_digests` of a dataset's chosen episodes that are not held out. There are none if it is
    not here, or not whole."""
    try:
        table = read_episodes(open_dataset(root, episodes=episodes))
    except FieldError:
        return []
    return action_digests(table, np.flatnonzero(table.training(episodes)))


def action_digests(table: EpisodeTable, episodes: np.ndarray) -> list[str]:
    """Return a digest of the actions of each of these episodes (E,): copies keep them, whatever columns they
    lose."""
    return [sha256(table.action[rows].astype("<f4").tobytes()).hexdigest() for rows in table.rows(episodes)]


class Training(NamedTuple):
    """A checkpoint, and the settings of the training that made it, nothing if they are not here."""

    checkpoint: str
    settings: Mapping[str, Any]

    def located(self, path: object) -> str:
        """Return where something lies that the settings name: relative paths are from where the training ran,
        which its own `output_dir` tells, as far as folders above that need no name. "" for nothing; as it is
        if it is not there, such as a hub id."""
        if not path:
            return ""
        folder = training_folder(self.checkpoint)
        parts = Path(str(self.settings.get("output_dir") or "")).parts
        up = parts.count("..")
        if not parts[up:] or folder.parts[up - len(parts) :] != parts[up:]:
            return str(path)
        place = Path(normpath(Path(*folder.parts[: up - len(parts)], *["?"] * up, str(path))))
        return str(place if place.exists() else path)


def _trainings(checkpoint: str, trained: str) -> Iterator[Training]:
    """Yield a checkpoint with the training that made it, then those that it goes back to.

    trained: name of the settings of what was trained, `policy` or `model`.
    """
    visited, ahead = set(), [checkpoint]
    while ahead:
        if (checkpoint := ahead.pop(0)) in visited:
            continue
        visited.add(checkpoint)
        training = Training(checkpoint, stored_settings(model_folder(checkpoint) / RUN_CONFIG_FILE))
        yield training
        made = training.settings.get(trained) or {}
        if began := training.located(made.get("pretrained_path")):
            ahead.append(began)
        if (tokenizer := training.located(made.get("tokenizer_path"))) and tells_success(tokenizer):
            ahead.append(tokenizer)


def tells_success(tokenizer: str) -> bool:
    """Return whether a tokenizer has learnt from labels: its world models read success by its classifier."""
    config = stored_settings(model_folder(tokenizer) / "config.json")
    return bool((config.get("tokenizer") or {}).get("success"))


def stored_settings(path: Path) -> dict[str, Any]:
    """Return the content of a file of settings, nothing if there is none."""
    content = json.loads(path.read_text()) if path.is_file() else {}
    return content if isinstance(content, dict) else {}


def same_training(one: str, other: str) -> bool:
    """Return whether two checkpoints are the same or of the same training."""
    return one == other or _same(training_folder(one), training_folder(other))


def training_folder(checkpoint: str) -> Path:
    """Return the output folder of the training that made a checkpoint, or the checkpoint itself."""
    folder = model_folder(checkpoint).resolve()
    folder = folder.parent if folder.name == PRETRAINED_MODEL_DIR else folder
    return folder.parents[1] if folder.parent.name == CHECKPOINTS_DIR else folder


def _same(one: Path, other: Path) -> bool:
    return one.exists() and other.exists() and one.samefile(other)
