"""What the trainer needs of a policy's processors."""

from pathlib import Path

import torch

from lerobot_wmrl.common.pipeline import make_pipeline
from lerobot_wmrl.common.policies import load_processors, read_policy_config
from tests.rl.checkpoints import save_untrained_policy

IMAGE = "observation.images.third_view"


def test_the_pipeline_gives_the_policy_what_it_knows(tmp_path: Path) -> None:
    config = read_policy_config(str(save_untrained_policy(tmp_path)), [])
    pipeline = make_pipeline(config, *load_processors(config))
    observation = {
        IMAGE: torch.rand(2, 3, 32, 32),
        "observation.images.wrist": torch.rand(2, 3, 8, 8),
        "task": ["a", "b"],
    }
    prepared = pipeline.prepare(observation)
    assert "observation.images.wrist" not in prepared
    assert torch.equal(prepared[IMAGE], observation[IMAGE])
    assert prepared["task"] == ["a", "b"]
    raw = torch.randn(2, 3)
    assert torch.equal(pipeline.to_action(raw), raw)


def test_actions_stay_on_the_policys_device(tmp_path: Path) -> None:
    """Here PyTorch's device without memory, from which nothing can be fetched."""
    config = read_policy_config(str(save_untrained_policy(tmp_path)), [])
    processors = load_processors(config)
    config.device = "meta"
    raw = torch.zeros(2, 3, device="meta")
    assert make_pipeline(config, *processors).to_action(raw).device.type == "meta"
    assert processors[1].steps[-1].device == "cpu"
