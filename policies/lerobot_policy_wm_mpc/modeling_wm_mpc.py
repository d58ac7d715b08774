"""Planning inside a world model (model-predictive control): what lerobot-eval runs, untrained."""

from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_policy_wm_mpc.configuration_wm_mpc import WmMpcConfig
from lerobot_policy_wm_mpc.planning import Objective, best_knots, interpolated, longest_success
from lerobot_wmrl.common.constants import ACTION_HIGH, ACTION_LOW
from lerobot_wmrl.data.compatibility import check_same_tokenizer
from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.goal import imagine_goal, similarity_to_goal
from lerobot_wmrl.world_models.modeling_frame_tokenizer import stack_cameras
from lerobot_wmrl.world_models.open_loop import open_loop

Observation = dict[str, Any]


class WmMpcPolicy(PreTrainedPolicy):
    """Imagines action sequences from the present frame and carries out the beginning of the best one.

    The world models are no part of the checkpoint, which holds no weights at all.
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
            where = f"--policy.text_world_model_path={config.text_world_model_path}"
            check_same_tokenizer(self._model[0], text_model, where)
            self._text_model.append(text_model)
        self.register_buffer("low", torch.tensor(ACTION_LOW), persistent=False)
        self.register_buffer("high", torch.tensor(ACTION_HIGH), persistent=False)
        self.reset()

    def get_optim_params(self) -> dict[str, Any]:
        """None: nothing is trained."""
        return {}

    def forward(self, batch: Observation, **_: Any) -> tuple[Tensor, dict[str, Any]]:
        """Nothing is trained."""
        raise NotImplementedError("policy.type=wm_mpc plans; there is nothing to train")

    def reset(self) -> None:
        """Episodes begin: what was planned and seen is forgotten."""
        self._chunk: Tensor | None = None
        self._next = 0
        self._knots: Tensor | None = None
        self._context: Context | None = None
        self._generator = torch.Generator(self.low.device).manual_seed(self.config.seed)

    @torch.no_grad()
    def select_action(self, batch: Observation, **_: Any) -> Tensor:
        """The next action of the plan, a new one after `execute` of them. → (B, A)"""
        if self._chunk is None or self._next == self.config.execute:
            self._chunk, self._next = self.predict_action_chunk(batch), 0
        self._next += 1
        return self._chunk[:, self._next - 1]

    @torch.no_grad()
    def predict_action_chunk(self, batch: Observation, **_: Any) -> Tensor:
        """Plan from images (B, 3, H, W), state (B, P) and instructions. → the whole plans (B, T, A)"""
        model, config = self._model[0], self.config
        images = stack_cameras(batch, model.config.tokenizer.camera_keys, model.config.tokenizer.image_size)
        if self._context is None:
            self._context = model.tokenizer.context(images)
        tokens = model.tokenizer.encode(images, self._context)
        spread = torch.where(model.action_std == 1, 0.0, model.action_std)  # those of constants are set to 1
        start = self._shifted() if self._knots is not None else None
        plans = []
        for row in range(len(tokens)):
            mean = model.action_mean.expand(config.knots, -1) if start is None else start[row]
            plans.append(best_knots(
                self._objective(batch, tokens, row), mean, config.spread * spread, self.low, self.high,
                horizon=config.horizon, samples=config.samples, elites=config.elites,
                iterations=config.iterations, generator=self._generator,
            ))  # fmt: skip
        self._knots = torch.stack(plans)
        return interpolated(self._knots, config.horizon)

    def _shifted(self) -> Tensor:
        """What is left of the plans, its last action held: knots (B, N, A) to begin with."""
        assert self._knots is not None
        config = self.config
        plans = interpolated(self._knots, config.horizon)
        ahead = torch.linspace(config.execute, config.execute + config.horizon - 1, config.knots)
        return plans[:, ahead.round().long().clamp(max=config.horizon - 1)]

    def _objective(self, batch: Observation, tokens: Tensor, row: int) -> Objective:
        """How good action sequences are in environment `row`."""
        model, config = self._model[0], self.config
        context = self._context[[row]] if self._context else NO_CONTEXT
        state = batch.get(OBS_STATE, tokens.new_zeros(len(tokens), 0, dtype=torch.float32))[[row]]
        goal = None
        if config.objective == "goal":
            instruction = [batch["task"][row]]
            goal = imagine_goal(self._text_model[0], tokens[[row]], state, instruction, context).decoded

        def value(actions: Tensor) -> Tensor:
            every = [0] * len(actions)
            seen = context[every] if len(context) else NO_CONTEXT
            ahead = open_loop(model, tokens[[row] * len(actions)], state[every], actions, seen)
            if goal is None:
                return longest_success(ahead.done_logit, config.done_frames)
            features = [layer.repeat(len(actions), 1, 1, 1) for layer in goal.features]
            return similarity_to_goal(model.tokenizer, ahead.tokens, features, seen)

        return value
