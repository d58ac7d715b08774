"""Publishes a finished recording on the Hugging Face hub, with its own card, which LeRobot's push would
replace."""

from contextlib import suppress
from pathlib import Path
from typing import Final

from huggingface_hub import HfApi
from huggingface_hub.constants import REPO_TYPE_DATASET
from huggingface_hub.errors import RevisionNotFoundError
from lerobot.datasets.dataset_metadata import CODEBASE_VERSION

from lerobot_dataset_maniskill.card import CARD_FILE, MEDIA, name_card
from lerobot_wmrl.common.hub import create_repo, publishing

PUBLISHED: Final = [str(CARD_FILE), *(f"{folder}/*" for folder in ("data", "meta", "videos", MEDIA))]
"""The files of a dataset: they are uploaded, and removed from the hub where the recording has them not."""

ONLY_PUBLISHES: Final = "the recording is whole in {root}, the same command again only publishes it"


def publish(api: HfApi, root: Path, repo_id: str, private: bool) -> None:
    """Make the hub's dataset `repo_id` equal to the one at `root`; nothing changes if it is equal already.

    Args:
        api: the client.
        root: root of the dataset.
        repo_id: its name on the hub.
        private: whether it must be private there.

    Raises:
        FieldError: says what the hub refuses, or that it cannot be reached.
    """
    name_card(root, repo_id)
    with publishing(repo_id, ONLY_PUBLISHES.format(root=root)):
        create_repo(api, repo_id, private, REPO_TYPE_DATASET)
        api.upload_folder(
            repo_id=repo_id,
            repo_type=REPO_TYPE_DATASET,
            folder_path=root,
            allow_patterns=PUBLISHED,
            delete_patterns=PUBLISHED,
        )
        tag_version(api, repo_id)
    print(f"published: {api.endpoint}/datasets/{repo_id}")


def tag_version(api: HfApi, repo_id: str) -> None:
    """Tag the head with the version of LeRobot's format, by which LeRobotDataset finds it."""
    with suppress(RevisionNotFoundError):
        api.delete_tag(repo_id, tag=CODEBASE_VERSION, repo_type=REPO_TYPE_DATASET)
    api.create_tag(repo_id, tag=CODEBASE_VERSION, repo_type=REPO_TYPE_DATASET)
