"""Publishing trained models on the Hugging Face hub, each with a card that says what it is."""

import logging
import re
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, Final

from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, ModelCard, ModelCardData

from lerobot_wmrl.common.hub import create_repo, publishing

CARD = """---
{metadata}
---

# {name}

{summary}

Trained with `lerobot_env_wmrl` on {dataset}. Weights, statistics and configuration are all in this
repository. Load it with:

```python
import lerobot_wmrl
from lerobot.rewards.factory import get_reward_model_class

model = get_reward_model_class("{type}").from_pretrained("{repo_id}")
```
"""


def card_metadata(config: Any, *tags: str, **more: Any) -> ModelCardData:
    """Return the metadata of the card of a model with this configuration, as LeRobot's own cards have it."""
    return ModelCardData(
        license=config.license or "apache-2.0",
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=sorted({*(config.tags or []), "robotics", "lerobot", *tags, config.type}),
        **more,
    )


class HubCard:
    """Mixin of `PreTrainedRewardModel`: how a model is published; `summary` says on its card what it is."""

    summary: ClassVar[str] = ""

    def push_model_to_hub(self, cfg: Any, **_: Any) -> None:
        """Upload weights, configuration, training configuration and card to `config.repo_id`.

        lerobot-train also hands over what only policies take: a gathered state and the dataset's metadata.
        """
        model: Any = self
        api = HfApi()
        kept = f"the model is whole in {cfg.output_dir}"
        with publishing(model.config.repo_id, kept), TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            repo_id = create_repo(api, model.config.repo_id, model.config.private)
            model.save_pretrained(folder)
            cfg.save_pretrained(Path(folder))
            self.generate_model_card(cfg.dataset.repo_id).save(Path(folder) / "README.md")
            commit = api.upload_folder(
                repo_id=repo_id, folder_path=folder, commit_message=f"Upload {model.config.type}"
            )
        logging.info("published at %s", commit.repo_url.url)

    def generate_model_card(self, dataset_repo_id: str | None, *_: Any, **__: Any) -> ModelCard:
        """Write the model's card."""
        config: Any = self.config  # type: ignore[attr-defined]
        metadata = card_metadata(config, "reward-model", datasets=dataset_repo_id)
        return ModelCard(
            CARD.format(
                metadata=metadata.to_yaml(),
                name=config.type,
                summary=self.summary,
                type=config.type,
                dataset=f"`{dataset_repo_id}`" if dataset_repo_id else "a dataset that is not published",
                repo_id=config.repo_id,
            )
        )


EVALUATION: Final = "evaluation"
"""Folder of a published model's evaluation."""

SECTION: Final = """<!-- evaluation -->

{text}

<!-- end of evaluation -->
"""


def publish_evaluation(name: str, text: str, files: Mapping[str, bytes]) -> None:
    """Put what an evaluation has found on the card of a published model, in place of an earlier one.

    Args:
        name: the model's on the hub, user/name.
        text: what was found, in Markdown. It shows pictures by their paths, `evaluation/…`.
        files: files of the folder `evaluation`, by name.

    Raises:
        FieldError: it may not be written, or the hub cannot be reached.
    """
    api = HfApi()
    with publishing(f"the evaluation of {name}", "repeat the command"):
        card = ModelCard.load(name)
        before = re.sub(r"<!-- evaluation -->.*<!-- end of evaluation -->", "", card.text, flags=re.S)
        card.text = f"{before.rstrip()}\n\n{SECTION.format(text=text)}"
        content = {f"{EVALUATION}/{file}": data for file, data in files.items()}
        earlier = {path for path in api.list_repo_files(name) if path.startswith(f"{EVALUATION}/")}
        operations = [
            *(CommitOperationDelete(path) for path in sorted(earlier - content.keys())),
            *(CommitOperationAdd(path, data) for path, data in content.items()),
            CommitOperationAdd("README.md", str(card).encode()),
        ]
        commit = api.create_commit(name, operations, commit_message="Add an evaluation")
    logging.info("published at %s", commit.repo_url)
