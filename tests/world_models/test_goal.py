import pytest
import torch
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.world_models import goal as goal_module
from lerobot_wmrl.world_models.configuration_world_model import TextWorldModelConfig
from lerobot_wmrl.world_models.goal import Goal, imagine_goal
from lerobot_wmrl.world_models.modeling_world_model import TextWorldModelRewardModel
from tests.world_models.made_up_clips import STATE, random_frames, text_model

B, HORIZON = 8, 6
INSTRUCTIONS = ["push"] * B


@pytest.fixture(scope="module")
def model() -> TextWorldModelRewardModel:
    """Random weights, large enough for done probabilities that rise and fall in each imagination."""
    model = text_model().eval()
    torch.manual_seed(1)
    for parameter in model.dynamics.network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return model


def starts() -> Frames:
    return Frames(random_frames(B), torch.zeros(B, STATE))


def imagine(model: TextWorldModelRewardModel, threshold: float, horizon: int = HORIZON) -> Goal:
    model.config.goal_horizon = horizon
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(goal_module, "GOAL_THRESHOLD", threshold)
        return imagine_goal(model, starts(), INSTRUCTIONS)


def trajectory(model: TextWorldModelRewardModel) -> tuple[Tensor, Tensor]:
    """The whole imagination: done probabilities (B, HORIZON) and the tokens they speak of (B, HORIZON, S)."""
    state = model.start(starts(), INSTRUCTIONS)
    steps = [model.step(state) for _ in range(HORIZON)]
    return (
        torch.stack([step.done_logit.sigmoid() for step in steps], 1),
        torch.stack([step.tokens for step in steps], 1),
    )


def test_the_goal_is_the_first_frame_whose_done_reaches_the_threshold_else_the_likeliest(model):
    """Eq. 6 by its definition, at a threshold that half of the imaginations reach."""
    probability, tokens = trajectory(model)
    threshold = probability.max(1).values.median().item()
    goal = imagine(model, threshold)
    for row in range(B):
        reaching = (probability[row] >= threshold).nonzero().flatten()
        expected = reaching[0] if len(reaching) else probability[row].argmax()
        assert torch.equal(goal.tokens[row], tokens[row, expected])
        assert goal.reached[row] == bool(len(reaching))
    assert goal.reached.any()
    assert not goal.reached.all()


def test_a_later_frame_of_higher_probability_does_not_replace_the_first_that_reached(model):
    probability, tokens = trajectory(model)
    row = int((probability.argmax(1) > 0).nonzero()[0])
    threshold = probability[row, 0].item()
    goal = imagine(model, threshold)
    assert torch.equal(goal.tokens[row], tokens[row, 0])
    assert goal.reached[row]


def test_the_search_ends_at_the_horizon(model):
    _, tokens = trajectory(model)
    goal = imagine(model, 0.9999, horizon=1)
    assert torch.equal(goal.tokens, tokens[:, 0])
    assert not goal.reached.any()


def test_an_impossible_horizon_is_named():
    with pytest.raises(FieldError, match=r"^goal_horizon=0: must be at least 1"):
        TextWorldModelConfig(device="cpu", goal_horizon=0)
