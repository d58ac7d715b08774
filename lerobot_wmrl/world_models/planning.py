"""Planning inside a world model: the cross-entropy method on action sequences (Rubinstein 1999).

B searches at once, K samples of each, T frames, N knots, A action components.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.world_models.configuration_planner import PlannerSettings
from lerobot_wmrl.world_models.dynamics import repeated_rows
from lerobot_wmrl.world_models.goal import imagine_goal, select_features, similarity_to_goal

MIN_STD_SHARE = 0.05
"""Share of the first standard deviation below which it does not shrink."""

Objective = Callable[[Tensor], Tensor]
"""Value of action sequences, K for each of B searches, search by search: (B·K, T, A) → (B·K,)."""


def interpolate_knots(knots: Tensor, horizon: int) -> Tensor:
    """Interpolate evenly spaced knots (B, N, A) linearly. → (B, horizon, A)"""
    return F.interpolate(knots.transpose(1, 2), horizon, mode="linear", align_corners=True).transpose(1, 2)


def plan_knots(
    objective: Objective,
    mean: Tensor,
    std: Tensor,
    low: Tensor,
    high: Tensor,
    *,
    horizon: int,
    samples: int,
    elites: int,
    iterations: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Search the best knots by the cross-entropy method, B searches at once.

    The mean that a search begins at, within the bounds, and that of each iteration but the last, is among
    the evaluated sequences, so the best is no worse; of equally good ones it is the first mean.

    Args:
        objective: value of action sequences.
        mean: knots to begin with (B, N, A).
        std: standard deviation of the first samples (A,).
        low, high: bounds of actions (A,).

    Returns:
        The best knots of all samples, and the mean of the last elites, which varies less from one search to
        the next; (B, N, A) each.
    """
    searches, first, deviation = len(mean), std, std.expand_as(mean)
    mean = mean.clamp(low, high)
    best, best_value = mean, None
    for _ in range(iterations):
        noise = torch.randn(searches, samples, *mean.shape[1:], generator=generator, device=mean.device)
        knots = (mean[:, None] + deviation[:, None] * noise).clamp(low, high)  # (B, K, N, A)
        knots[:, 0] = mean
        value = objective(interpolate_knots(knots.flatten(0, 1), horizon)).unflatten(0, (searches, -1))
        top = value.topk(elites, 1)
        rows = torch.arange(searches, device=mean.device)[:, None]
        elite = knots[rows, top.indices]  # (B, elites, N, A)
        best_value = value[:, 0] if best_value is None else best_value
        better = top.values[:, 0] > best_value
        best = torch.where(better[:, None, None], elite[:, 0], best)
        best_value = torch.where(better, top.values[:, 0], best_value)
        mean = elite.mean(1)
        deviation = torch.maximum(elite.std(1, unbiased=False), MIN_STD_SHARE * first)
    return best, mean


def success_logit(done_logit: Tensor, frames: int) -> Tensor:
    """Return the highest logit at which done holds for `frames` consecutive frames. (K, T) → (K,)"""
    return done_logit.unfold(1, frames, 1).amin(-1).amax(1)


class Planner:
    """Plans for B imaginations at once.

    Args:
        model: the action world model to plan in.
        text_model: maximise the similarity of the last frame to its goal frames, in place of success.
        settings: settings of the search.
        done_frames: consecutive done frames that make a success.
        averaged: follow the mean of the last elites in place of the best sample.
        low, high: bounds of actions (A,).
        seed: seed of the samples.
        searched: components of actions that are searched, of those that vary in the model's data; by default
            all. (A,) bool
    """

    def __init__(
        self,
        model: Any,
        text_model: Any,
        settings: PlannerSettings,
        done_frames: int,
        averaged: bool,
        low: Tensor,
        high: Tensor,
        seed: int,
        searched: Tensor | None = None,
    ) -> None:
        self.model, self.text_model = model, text_model
        self.settings, self.done_frames, self.averaged = settings, done_frames, averaged
        self.low, self.high, self.seed = low, high, seed
        deviation = model.action_deviation()
        self.std = settings.spread * (deviation if searched is None else deviation * searched)  # (A,)
        self.reset()

    def reset(self) -> None:
        """Forget the plans, and seed the samples."""
        self.knots: Tensor | None = None
        self.generator = torch.Generator(self.low.device).manual_seed(self.seed)

    @torch.no_grad()
    def plan(
        self,
        frames: Frames,
        instructions: Sequence[str],
        proposed: Tensor | None = None,
        steps_left: int | None = None,
    ) -> Tensor:
        """Plan from these frames on.

        Args:
            frames: B of them.
            instructions: one a frame.
            proposed: actions (B, T, A) to change. The search samples changes at the knots; its first sample
                changes nothing. By default the search begins at what is left of the last plans.
            steps_left: steps until the episodes end, after which success does not count, but for the first
                `done_frames`; nor does it with goal frames.

        Returns:
            (B, T, A)
        """
        model, settings = self.model, self.settings
        value = self._objective(frames, instructions, steps_left)

        def search(objective: Objective, mean: Tensor, low: Tensor, high: Tensor) -> Tensor:
            best, average = plan_knots(
                objective,
                mean,
                self.std,
                low,
                high,
                horizon=settings.horizon,
                samples=settings.samples,
                elites=settings.elites,
                iterations=settings.iterations,
                generator=self.generator,
            )
            return average if self.averaged else best

        if proposed is not None:
            no_change = proposed.new_zeros(len(frames), settings.knots, proposed.shape[-1])
            span = self.high - self.low
            knots = search(lambda change: value(self._changed(proposed, change)), no_change, -span, span)
            return self._changed(proposed, interpolate_knots(knots, settings.horizon))
        mean = model.action_mean.expand(len(frames), settings.knots, -1)
        if self.knots is not None:
            mean = self._remaining_knots(interpolate_knots(self.knots, settings.horizon))
        self.knots = search(value, mean, self.low, self.high)
        return interpolate_knots(self.knots, settings.horizon)

    def _changed(self, proposed: Tensor, change: Tensor) -> Tensor:
        """Add changes (B·K, T, A), K for each proposal (B, T, A), within the bounds. → (B·K, T, A)"""
        each = proposed.repeat_interleave(len(change) // len(proposed), 0)
        return (each + change).clamp(self.low, self.high)

    def _remaining_knots(self, plans: Tensor) -> Tensor:
        """Return the knots of plans after the executed steps, the last action held. (B, T, A) → (B, N, A)"""
        settings = self.settings
        steps = torch.linspace(settings.execute, settings.execute + settings.horizon - 1, settings.knots)
        return plans[:, steps.round().long().clamp(max=settings.horizon - 1)]

    def _objective(self, frames: Frames, instructions: Sequence[str], steps_left: int | None) -> Objective:
        """Return the objective of action sequences that begin at these frames."""
        model, done_frames = self.model, self.done_frames
        if self.text_model is None:
            counted = None if steps_left is None else max(steps_left, done_frames)
            return lambda actions: success_logit(
                model.open_loop(frames, actions, with_tokens=False).done_logit[:, :counted], done_frames
            )
        goal = imagine_goal(self.text_model, frames, instructions).decoded

        def similarity(actions: Tensor) -> Tensor:
            rows = repeated_rows(len(frames), len(actions), actions.device)
            features = select_features(goal.features, rows, model.tokenizer.num_cameras)
            tokens = model.open_loop(frames, actions).tokens
            return similarity_to_goal(model.tokenizer, tokens, features, frames.context[rows])

        return similarity
