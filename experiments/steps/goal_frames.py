"""How good are the goal frames of text world models that share a tokenizer?

    python -m experiments.steps.goal_frames outputs/anchored_0 outputs/autoregressive_0 \\
        --dataset.root=outputs/dataset --split=validation --output=outputs/goals.json

Every model imagines a goal frame from the first frame of each chosen episode. Three things are measured:
the distance to the nearest recorded final frame of the same instruction; the share of goal frames in which
success holds, by one success probe for all models; and what the reward needs, that recorded successes end
more similar to the goal frame of their own start than recorded failures do (AUC, all pairs). The last is
repeated with the goal frames of other starts: a goal frame that does not depend on its start loses nothing
by that.
"""

import argparse
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from experiments.steps.gates import training_minutes
from lerobot_wmrl.common.constants import START_SCENE
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.statistics import RESAMPLES, roc_auc
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import choose_episodes, read_episodes
from lerobot_wmrl.data.frame_cache import frames_to_tensor
from lerobot_wmrl.evaluation.goals import goal_quality, imagine_goals
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.evaluation.success_probe import TrainedProbe, train_probe
from lerobot_wmrl.maniskill.recordings import scene_splits
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.goal import imagine_goal, similarity_to_goal
from lerobot_wmrl.world_models.modeling_world_model import TextWorldModelRewardModel

MODEL: Final = "text_world_model"


@torch.no_grad()
def similarity_of_ends(
    model: TextWorldModelRewardModel, recording: Recording, episodes: np.ndarray, shift: int
) -> np.ndarray:
    """Return how similar each episode's last frame is to the goal of the episode `shift` further. (E,)"""
    table, others = recording.table, np.roll(episodes, shift)
    instructions = [table.instructions[episode] for episode in others]
    starts = recording.starts(model, others)
    goal = imagine_goal(model, starts, instructions)
    last = table.start[episodes] + table.length[episodes] - 1
    images = frames_to_tensor(recording.frames[last]).to(starts.tokens.device)
    context = recording.first_frames(episodes, model.tokenizer)[1]
    tokens = model.tokenizer.encode(images, context)
    return similarity_to_goal(model.tokenizer, tokens, goal.decoded.features, context).cpu().numpy()


def auc(similarity: np.ndarray, success: np.ndarray) -> dict[str, Any]:
    """Return the share of pairs in which the success is the more similar, with a bootstrap over episodes."""
    rng = np.random.default_rng(0)
    draws = (rng.choice(len(success), len(success)) for _ in range(RESAMPLES))
    low, high = np.nanquantile([roc_auc(similarity[rows], success[rows]) for rows in draws], (0.025, 0.975))
    return {
        "value": roc_auc(similarity, success),
        "bootstrap_95": [float(low), float(high)],
        "successes": int(success.sum()),
        "failures": int((~success).sum()),
    }


def measure(
    folder: Path, recording: Recording, episodes: np.ndarray, probe: TrainedProbe | None
) -> dict[str, Any]:
    """Measure the goal frames of one trained model, and the seconds that one takes."""
    model = load_model(folder, MODEL)
    success = recording.table.success[episodes]
    began = time.perf_counter()
    goals = imagine_goals(model, recording, episodes)
    seconds = (time.perf_counter() - began) / len(goals.episodes)
    return {
        **training_minutes(folder),
        "seconds_a_goal": seconds,
        **goal_quality(goals, probe).as_json(),
        "auc": auc(similarity_of_ends(model, recording, episodes, 0), success),
        "auc_of_other_starts": auc(similarity_of_ends(model, recording, episodes, 1), success),
    }


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", nargs="+", type=Path, help="output folders of their trainings")
    parser.add_argument("--dataset.root", dest="root", required=True, help="recorded episodes")
    parser.add_argument("--split", default="all", help="which of them, as in lerobot-wmrl-eval-world-model")
    parser.add_argument("--max_episodes", type=int, default=200, help="evenly spread")
    parser.add_argument("--output", type=Path, required=True, help="JSON file")
    return parser


def main() -> None:
    """Entry point."""
    given = make_parser().parse_args()
    table = read_episodes(open_dataset(given.root, None))
    scenes = scene_splits(table.column(START_SCENE), given.split)
    episodes = choose_episodes(table, given.split, given.max_episodes, scenes)
    first = load_model(given.models[0], MODEL)
    recording = Recording.read(table, first)
    probe = train_probe(first.tokenizer, recording)
    write_json(
        given.output,
        {path.name: measure(path, recording, episodes, probe) for path in given.models},
    )


if __name__ == "__main__":
    main()
