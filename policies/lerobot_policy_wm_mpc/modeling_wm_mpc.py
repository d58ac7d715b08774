"""Model-predictive control inside a world model, as a policy that lerobot-eval runs."""

from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_policy_wm_mpc.configuration_wm_mpc import WmMpcConfig
from lerobot_policy_wm_mpc.planning import Objective, interpolate_knots, plan_knots, success_logit
from lerobot_wmrl.common.constants import ACTION_HIGH, ACTION_LOW
from lerobot_wmrl.data.frames import Context, Frames
from lerobot_wmrl.world_models.checkpoint import check_same_tokenizer, load_model
from lerobot_wmrl.world_models.goal import imagine_goal, similarity_to_goal
from lerobot_wmrl.world_models.modeling_frame_tokenizer import stack_cameras

Observation = dict[str, Any]


class WmMpcPolicy(PreTrainedPolicy):
    """Imagine action sequences from the present frame and execute the beginning of the best one.

    The checkpoint holds no weights: the world models stay where `world_model_path` says.
    """

    config_class = WmMpcConfig
    name = "wm_mpc"

    def __init__(self, config: WmMpcConfig, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        device = config.device or "cpu"
        self._model = [load_model(config.world_model_path, "action_world_model", device)]
        self._text_model = []
        if config.text_world_model_path:
            text_model = load_model(config.text_world_model_path, "text_world_model", device)
            path = config.text_world_model_path
            check_same_tokenizer(self._model[0], text_model, "text_world_model_path", path)
            self._text_model.append(text_model)
        self.register_buffer("low", torch.tensor(ACTION_LOW), persistent=False)
        self.register_buffer("high", torch.tensor(ACTION_HIGH), persistent=False)
        self.reset()

    def get_optim_params(self) -> dict[str, Any]:
        """Return no parameters: nothing is trained."""
        return {}

    def forward(self, batch: Observation, **_: Any) -> tuple[Tensor, dict[str, Any]]:
        """Raise NotImplementedError: nothing is trained."""
        raise NotImplementedError("the policy wm_mpc plans; it has nothing to train")

    def reset(self) -> None:
        """Forget the plans and the first frame of the last episodes."""
        self._chunk: Tensor | None = None
        self._next = 0
        self._knots: Tensor | None = None
        self._context: Context | None = None
        self._generator = torch.Generator(self.low.device).manual_seed(self.config.seed)

    @torch.no_grad()
    def select_action(self, batch: Observation, **_: Any) -> Tensor:
        """Return the next action of the plan; plan again after `execute` actions. → (B, A)"""
        if self._chunk is None or self._next == self.config.execute:
            self._chunk, self._next = self.predict_action_chunk(batch), 0
        self._next += 1
        return self._chunk[:, self._next - 1]

    @torch.no_grad()
    def predict_action_chunk(self, batch: Observation, **_: Any) -> Tensor:
        """Plan from images (B, 3, H, W), state (B, P) and instructions. → (B, T, A)"""
        model, config = self._model[0], self.config
        images = stack_cameras(batch, model.config.tokenizer.camera_keys, model.config.tokenizer.image_size)
        if self._context is None:
            self._context = model.tokenizer.context(images)
        tokens = model.tokenizer.encode(images, self._context)
        state = batch.get(OBS_STATE, tokens.new_zeros(len(tokens), 0, dtype=torch.float32))
        frames, instructions = Frames(tokens, state, self._context), list(batch.get("task", []))
        # Statistics hold a std of 1 for components that never vary: these stay at their mean.
        std = torch.where(model.action_std == 1, 0.0, model.action_std)
        start = self._remaining_plans() if self._knots is not None else None
        plans = []
        for row in range(len(tokens)):
            mean = model.action_mean.expand(config.knots, -1) if start is None else start[row]
            plans.append(plan_knots(
                self._objective(frames[[row]], instructions[row : row + 1]), mean, std, self.low, self.high,
                horizon=config.horizon, samples=config.samples, elites=config.elites,
                iterations=config.iterations, generator=self._generator,
            ))  # fmt: skip
        self._knots = torch.stack(plans)
        return interpolate_knots(self._knots, config.horizon)

    def _remaining_plans(self) -> Tensor:
        """Return the knots of what is left of the plans, the last action held. → (B, N, A)"""
        assert self._knots is not None
        config = self.config
        plans = interpolate_knots(self._knots, config.horizon)
        ahead = torch.linspace(config.execute, config.execute + config.horizon - 1, config.knots)
        return plans[:, ahead.round().long().clamp(max=config.horizon - 1)]

    def _objective(self, frame: Frames, instruction: list[str]) -> Objective:
        """Return the objective of action sequences that begin at one frame."""
        model, config = self._model[0], self.config
        goal = None
        if config.objective == "goal":
            goal = imagine_goal(self._text_model[0], frame, instruction).decoded

        def value(actions: Tensor) -> Tensor:
            frames = frame[[0] * len(actions)]
            ahead = model.open_loop(frames, actions)
            if goal is None:
                return success_logit(ahead.done_logit, config.done_frames)
            features = [layer.repeat(len(actions), 1, 1, 1) for layer in goal.features]
            return similarity_to_goal(model.tokenizer, ahead.tokens, features, frames.context)

        return value
