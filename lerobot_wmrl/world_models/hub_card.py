"""Publishing a trained model with LeRobot's own code, which knows how to describe its own models only."""

from typing import Any, ClassVar

from huggingface_hub import ModelCard

UNKNOWN_TYPE = "_Reward model type not recognized — please update this template._"
"""What LeRobot's card says of models that are not its own."""


class HubCard:
    """Mixed into a `PreTrainedRewardModel`: `summary` says on its card what the model is."""

    summary: ClassVar[str] = ""

    def push_model_to_hub(self, cfg: Any, **_: Any) -> None:
        """Weights, configuration, training configuration and card to `config.repo_id`.

        lerobot-train also hands over what only policies take: a gathered state and the dataset's metadata.
        """
        super().push_model_to_hub(cfg)  # type: ignore[misc]

    def generate_model_card(self, *args: Any, **kwargs: Any) -> ModelCard:
        """LeRobot's card, with this model's summary."""
        card = super().generate_model_card(*args, **kwargs)  # type: ignore[misc]
        card.text = card.text.replace(UNKNOWN_TYPE, self.summary)
        return card
