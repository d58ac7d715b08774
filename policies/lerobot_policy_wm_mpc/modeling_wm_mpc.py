"""Model-predictive control inside a world model, as a policy that lerobot-eval runs."""

from dataclasses import replace
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_policy_wm_mpc.configuration_wm_mpc import WmMpcConfig
from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.policies import LoadedPolicy, read_policy_config
from lerobot_wmrl.common.policy_checks import check_fit
from lerobot_wmrl.data.frames import Context, Frames
from lerobot_wmrl.world_models.checkpoint import check_same_tokenizer, load_model
from lerobot_wmrl.world_models.modeling_frame_tokenizer import stack_cameras
from lerobot_wmrl.world_models.planning import Planner


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
        model, text_model = load_model(config.world_model_path, "action_world_model", device), None
        if config.objective == "goal":
            text_model = load_model(config.text_world_model_path, "text_world_model", device)
            check_same_tokenizer(model, text_model, "text_world_model_path", config.text_world_model_path)
        elif model.config.learnt_successes == 0:
            raise FieldError(
                "world_model_path",
                config.world_model_path,
                "has learnt from no successful episode",
                "train it on a dataset with successes, or set `objective` to goal",
            )
        for field, each in (("world_model_path", model), ("text_world_model_path", text_model)):
            if each is not None and each.config.depth:
                raise FieldError(
                    field,
                    getattr(config, field),
                    "looks at depth, which environments do not show",
                    "plan in one without `dynamics.depth`",
                )
        low, high = model.action_range()
        self.planner = Planner(
            model,
            text_model,
            config,
            config.done_frames,
            averaged=False,
            low=low,
            high=high,
            seed=config.seed,
        )
        self.proposal = Proposal(config, model, low, high) if config.proposal_path else None
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
        self._context: Context | None = None
        self.planner.reset()

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
        model = self.planner.model
        images = stack_cameras(batch, model.config.tokenizer.camera_keys, model.config.tokenizer.image_size)
        if self._context is None:
            self._context = model.tokenizer.context(images)
        tokens = model.tokenizer.encode(images, self._context)
        state = self._state(batch, tokens)
        instructions = list(batch.get("task", []))
        weights = model.instruction_weights(instructions, len(tokens))
        frames = Frames(tokens, state, self._context, instruction_weights=weights)
        proposed = None
        if self.proposal is not None:
            own = replace(frames, state=state[:, : model.config.state_size])
            proposed = self.proposal.actions(own, batch, images, self.config.horizon)
        return self.planner.plan(frames, instructions, proposed)

    def _state(self, batch: Observation, tokens: Tensor) -> Tensor:
        """Return the robot's state (B, P), of no component where no world model has one.

        Raises:
            FieldError: it is missing, or has another number of components than a world model has learnt.
        """
        text_model, size = self.planner.text_model, self.planner.model.config.state_size
        field = "world_model_path"
        if text_model is not None and text_model.config.state_size > size:
            field, size = "text_world_model_path", text_model.config.state_size
        if not size:
            return tokens.new_zeros(len(tokens), 0, dtype=torch.float32)
        state: Tensor | None = batch.get(OBS_STATE)
        if state is None or state.shape[-1] != size:
            shown = "is missing" if state is None else f"has {state.shape[-1]} components"
            raise FieldError(
                field,
                getattr(self.config, field),
                f"has learnt a state of {size} components, and {OBS_STATE} {shown}",
                "plan where the world model's dataset was recorded, or train one without a state",
            )
        return state


class Proposal:
    """What a policy would do in the next steps, in the world model's imagination.

    Args:
        config: configuration of the planning policy, with the path of the other one.
        model: the world model.
        low, high: bounds of actions (A,).

    Raises:
        FieldError: there is no policy, or it looks at something that the world model does not imagine.
    """

    def __init__(self, config: WmMpcConfig, model: Any, low: Tensor, high: Tensor) -> None:
        self.model, self.low, self.high = model, low, high
        path = config.proposal_path
        try:
            policy_config = read_policy_config(path, [f"--device={config.device}"])
            check_fit(policy_config, model.config.observation_shapes, len(low))
            self.policy = LoadedPolicy.load(policy_config)
            model.check_units(policy_config, self.policy.postprocessor)
        except FieldError as error:
            raise FieldError("proposal_path", path, error.problem, error.remedy) from error

    def actions(self, frames: Frames, observed: Observation, images: Tensor, steps: int) -> Tensor:
        """Return the policy's next `steps` actions. → (B, T, A)

        Args:
            frames: B of them.
            observed: how an environment shows them, which the policy sees at its first step.
            images: their images as the tokenizer has them. (B, N, 3, S, S)
            steps: T.
        """
        self.policy.reset()
        instructions, real = list(observed.get("task", [])), [self.model.shown(observed)]

        def act(images: Tensor, state: Tensor) -> Tensor:
            observation = real.pop() if real else self.model.observation(images, state, instructions)
            return self.policy.act(observation).to(self.low.device).clamp(self.low, self.high)

        return self.model.policy_actions(frames, act, steps, images)
