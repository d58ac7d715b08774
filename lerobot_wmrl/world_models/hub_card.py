"""Publishing trained models on the Hugging Face hub, each with a card that says what it is."""

import logging
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

from huggingface_hub import HfApi, ModelCard, ModelCardData

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
