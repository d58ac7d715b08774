"""What the columns that our recorder adds say about episodes. Imports no simulator and decodes no video."""

import numpy as np

from lerobot_wmrl.common.constants import START_SCENE, START_SEED
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.seeds import EVALUATION_SEED, SELECTION_SEED
from lerobot_wmrl.data.episodes import EpisodeTable
from lerobot_wmrl.maniskill.scenes import scenes_of


def scene_splits(scene: np.ndarray, split: str) -> dict[str, np.ndarray]:
    """Mark the episodes in scenes that training may see, `ind`, and in those held out, `ood`.

    Args:
        scene: index of each episode's scene, −1 where it is not known. (E,)
        split: what is asked for.

    Returns:
        The two masks, (E,) each.

    Raises:
        FieldError: `split` asks for one of them, and no episode's scene is known.
    """
    asked = {"ind", "ood"} & {*split.split(",")}
    if asked and (scene < 0).all():
        raise FieldError(
            "split",
            split,
            "the dataset does not say which scenes its episodes are in (no column start.scene)",
            "choose all, train or validation",
        )
    held_out = np.isin(scene, [each.index for each in scenes_of("ood")])
    return {"ind": (scene >= 0) & ~held_out, "ood": (scene >= 0) & held_out}


def require_unmeasured(table: EpisodeTable) -> None:
    """Raise FieldError if results are reported on starts of the dataset: no policy may be chosen there.

    These have evaluation seeds, from `EVALUATION_SEED` on and below `SELECTION_SEED`. A dataset without seeds
    passes.
    """
    seeds = table.column(START_SEED)
    measured = (seeds >= EVALUATION_SEED) & (seeds < SELECTION_SEED)
    if measured.any():
        raise FieldError(
            "dataset.root",
            table.dataset.root,
            f"{measured.sum()} of {len(seeds)} episodes have evaluation seeds, on which results are "
            f"reported; the first is episode {np.argmax(measured)} (seed {seeds[measured][0]})",
            f"choose the policy on others, recorded with seeds from {SELECTION_SEED} on",
        )


def require_unreported(table: EpisodeTable, episodes: np.ndarray, remedy: str) -> None:
    """Raise FieldError if results are reported on some of the episodes, so that nothing may learn from them.

    These have evaluation seeds, from `EVALUATION_SEED` on, or unseen scenes. A dataset without seeds and
    scenes passes.

    Args:
        table: the dataset.
        episodes: indices of the episodes to learn from. (K,)
        remedy: how to choose others.
    """
    seed, scene = table.column(START_SEED)[episodes], table.column(START_SCENE)[episodes]
    reported = (seed >= EVALUATION_SEED) | np.isin(scene, [each.index for each in scenes_of("ood")])
    if reported.any():
        first = int(np.argmax(reported))
        raise FieldError(
            "dataset.root",
            table.dataset.root,
            f"{reported.sum()} of {len(episodes)} episodes to learn from have evaluation seeds or unseen "
            f"scenes, the first is episode {episodes[first]} (seed {seed[first]}, scene {scene[first]})",
            f"{remedy}, or record with seeds below {EVALUATION_SEED} in known scenes",
        )
