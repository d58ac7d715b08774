"""Publishing trained models on the Hugging Face hub, each with a card that says what it is."""

import logging
import re
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, Final

from huggingface_hub import CommitOperationAdd, HfApi, ModelCard, ModelCardData
from huggingface_hub.errors import HfHubHTTPError, HFValidationError

from lerobot_wmrl.common.errors import FieldError

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


class HubCard:
    """Mixin of `PreTrainedRewardModel`: how a model is published; `summary` says on its card what it is."""

    summary: ClassVar[str] = ""

    def push_model_to_hub(self, cfg: Any, **_: Any) -> None:
        """Upload weights, configuration, training configuration and card to `config.repo_id`.

        lerobot-train also hands over what only policies take: a gathered state and the dataset's metadata.
        """
        model: Any = self
        api = HfApi()
        repo_id = api.create_repo(model.config.repo_id, private=model.config.private, exist_ok=True).repo_id
        with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
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
        metadata = ModelCardData(
            license=config.license or "apache-2.0",
            library_name="lerobot",
            pipeline_tag="robotics",
            tags=sorted({*(config.tags or []), "robotics", "lerobot", "reward-model", config.type}),
            datasets=dataset_repo_id,
        )
        return ModelCard(
            CARD.format(
                metadata=metadata.to_yaml(), name=config.type, summary=self.summary, type=config.type,
                dataset=f"`{dataset_repo_id}`" if dataset_repo_id else "a dataset that is not published",
                repo_id=config.repo_id,
            )
        )  # fmt: skip


EVALUATION: Final = "evaluation"
"""Folder of a published model's evaluation."""

SECTION: Final = """<!-- evaluation -->

## What it imagines

{said}

{pictures}

{found}

<!-- end of evaluation -->
"""


def publish_evaluation(
    name: str, said: str, found: str, pictures: Sequence[Path], others: Sequence[Path]
) -> None:
    """Put what an evaluation has found on the card of a published model, in place of an earlier one.

    Args:
        name: the model's on the hub, user/name.
        said: what was done, in Markdown.
        found: what was found.
        pictures: files that the card shows between them.
        others: further files, which are uploaded beside.

    Raises:
        FieldError: it is not on the hub, or may not be written.
    """
    shown = "\n\n".join(f"![{path.stem.replace('_', ' ')}]({EVALUATION}/{path.name})" for path in pictures)
    try:
        card = ModelCard.load(name)
        before = re.sub(
            r"\s*<!-- evaluation -->.*<!-- end of evaluation -->\s*", "\n\n", card.text, flags=re.S
        )
        card.text = f"{before.rstrip()}\n\n{SECTION.format(said=said, pictures=shown, found=found)}"
        content = {f"{EVALUATION}/{path.name}": path.read_bytes() for path in (*pictures, *others)}
        operations = [
            CommitOperationAdd(path, data)
            for path, data in {"README.md": str(card).encode(), **content}.items()
        ]
        commit = HfApi().create_commit(name, operations, commit_message="Add an evaluation")
    except (HfHubHTTPError, HFValidationError) as error:
        raise FieldError(
            "push_to_hub", True, f"{name} cannot be written on the hub ({error})",
            "give the model by its name there, user/name, as `model.path`",
        ) from error  # fmt: skip
    logging.info("published at %s", commit.repo_url)
