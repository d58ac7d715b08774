"""The rule-based reward: what the simulator pays, for it knows where everything is."""

from dataclasses import dataclass

from torch import Tensor

from lerobot_wmrl.rewards.general import check_shape, general_reward


@dataclass
class RuleBasedReward:
    """Algorithm 1 with the simulator's success, and the task's own measure of progress for the similarity.

    Args:
        alpha: weight of success; progress has 1 − alpha.
        form: `potential` pays for progress made, `absolute` for being far on, in every step: since success
            ends an episode, that can be worth more than success.
        gamma: discount of the potential form; give it the algorithm's discount.
    """

    alpha: float = 0.9
    form: str = "potential"
    gamma: float = 0.97

    def __post_init__(self) -> None:
        check_shape(self.alpha, self.form, self.gamma)

    def of_step[Number: (float, Tensor)](self, success: Number, progress: Number, previous: Number) -> Number:
        """Of a step that led to `progress` in [0, 1] from `previous`. Numbers, or (B,) each."""
        return general_reward(success, progress, previous, alpha=self.alpha, form=self.form, gamma=self.gamma)
