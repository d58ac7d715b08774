"""Rollouts keep what happened: rewards at their steps, values of final observations, bytes of images."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig
from lerobot_wmrl.rl.minibatches import Minibatches, read_batch
from lerobot_wmrl.rl.observations import ObservationBuffer
from lerobot_wmrl.rl.rollout import Actor, RolloutBuffer, collect
from tests.read_backs import ReadBacks
from tests.rl.chunk_policy import ChunkPolicy
from tests.rl.point_env import PointEnv

HORIZON = 6


class Recorder(PointEnv):
    """Remembers what it was asked and what it answered."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.log: list[dict[str, Any]] = []

    def step(self, action: Tensor) -> Any:
        shown = self._observe()
        result = super().step(action)
        self.log.append(
            {
                "shown": shown,
                "action": action,
                "reward": result[1],
                "terminated": result[2],
                "truncated": result[3],
                "next": result[4].get("final_obs", result[0]),
            }
        )
        return result


def filled(
    policy: CnnPolicy, pipeline: Pipeline, steps: int = 20, **env: Any
) -> tuple[Recorder, RolloutBuffer, Any]:
    world, buffer = Recorder(16, horizon=HORIZON, **env), RolloutBuffer(steps, 16, "cpu")
    return world, buffer, collect(world, policy, pipeline, buffer, seed=3)


def test_every_step_keeps_its_own_outcome(make_policy: Callable[..., CnnPolicy], pipeline: Pipeline) -> None:
    world, buffer, _ = filled(make_policy(), pipeline)
    stored = buffer.observations.tensors["observation.state"]
    for step, seen in enumerate(world.log):
        assert torch.equal(stored[step], seen["shown"]["observation.state"])
        assert torch.equal(pipeline.to_action(buffer.raw_action[step]), seen["action"])
        assert torch.equal(buffer.reward[step], seen["reward"])
        assert torch.equal(buffer.terminated[step], seen["terminated"])
        assert torch.equal(buffer.truncated[step], seen["truncated"])
        assert torch.equal(buffer.success[step], seen["terminated"])


def test_the_next_value_is_that_of_the_observation_before_the_reset(
    make_policy: Callable[..., CnnPolicy], pipeline: Pipeline
) -> None:
    policy = make_policy()
    torch.nn.init.normal_(policy.critic[-1].weight)
    world, buffer, _ = filled(policy, pipeline)
    with torch.no_grad():
        expected = torch.stack([policy.value(seen["next"]) for seen in world.log])
    assert buffer.truncated.any()
    assert torch.allclose(buffer.next_value, expected, atol=1e-6)
    following = torch.cat([buffer.value[1:], buffer.value[-1:]])
    assert not torch.allclose(buffer.next_value[buffer.truncated], following[buffer.truncated], atol=1e-3)


def test_success_counts_the_first_episode_of_each_environment() -> None:
    buffer = RolloutBuffer(6, 2, "cpu")
    buffer.terminated[1, 0] = buffer.terminated[3, 0] = buffer.truncated[5, 1] = True
    buffer.success[1, 0] = buffer.success[3, 0] = True
    statistics = buffer.statistics()
    assert statistics["success_rate"] == 0.5
    assert statistics["episode_length"] == 4.0


def test_success_counts_later_episodes_that_had_the_time_to_end() -> None:
    """Others would count only if they are short, as successes are."""
    buffer = RolloutBuffer(6, 2, "cpu", longest=3)
    buffer.truncated[2] = True
    buffer.terminated[[3, 5], [0, 1]] = buffer.success[[3, 5], [0, 1]] = True
    buffer.terminated[5, 0] = buffer.success[5, 0] = True  # began in step 4: a failure would not have ended
    statistics = buffer.statistics()
    assert statistics["success_rate"] == 0.5
    assert statistics["episode_length"] == 2.5


def test_environments_whose_episodes_are_short_do_not_weigh_more() -> None:
    buffer = RolloutBuffer(6, 2, "cpu", longest=3)
    buffer.terminated[:, 0] = buffer.success[:, 0] = True
    buffer.truncated[[2, 5], 1] = True
    assert buffer.statistics()["success_rate"] == 0.5


def test_images_and_instructions_survive_as_bytes_and_indices() -> None:
    buffer, images = ObservationBuffer(2, 3), torch.randint(0, 256, (2, 3, 3, 8, 8)) / 255.0
    texts = [["push", "pull", "push"], ["lift", "push", "push"]]
    for step in range(2):
        buffer.write(step, {"observation.images.wrist": images[step], "task": texts[step]})
    assert buffer.tensors["observation.images.wrist"].dtype == torch.uint8
    read = buffer.read(torch.tensor([0, 3, 4]))
    assert torch.equal(
        read["observation.images.wrist"], torch.stack([images[0, 0], images[1, 0], images[1, 1]])
    )
    assert read["task"] == ["push", "lift", "push"]


def test_minibatches_visit_every_step_once_an_epoch(
    make_policy: Callable[..., CnnPolicy], pipeline: Pipeline
) -> None:
    _, buffer, _ = filled(make_policy(), pipeline)
    buffer.columns = {"row": torch.arange(20 * 16).view(20, 16)}
    batches = Minibatches(buffer, buffer.decided, pipeline, PPOConfig(epochs=2, minibatch_size=50))
    rows = torch.cat([steps["row"] for batch in batches for _, steps in batch.micro_batches()])
    assert len(batches) == 2 * 7
    assert torch.equal(rows.sort().values, torch.arange(320).repeat_interleave(2))


def test_actions_keep_their_values(make_policy: Callable[..., CnnPolicy], pipeline: Pipeline) -> None:
    """Continuous actions are stored as sampled: unclipped float32, with the log-probs they had."""
    policy = make_policy()
    _, buffer, _ = filled(policy, pipeline, image_size=0)
    assert buffer.raw_action.dtype == buffer.log_prob.dtype == torch.float32
    assert (buffer.raw_action.abs() > 1).any()
    batch = read_batch(buffer, torch.arange(320), pipeline)
    log_prob = policy.evaluate(batch["observation"], batch["raw_action"])[0]
    assert torch.allclose(log_prob, batch["log_prob"], atol=1e-5)


def test_a_rollout_is_its_seed_s_and_leaves_other_random_numbers_alone(
    make_policy: Callable[..., CnnPolicy], pipeline: Pipeline
) -> None:
    policy = make_policy()
    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    _, first, _ = filled(policy, pipeline)
    assert torch.equal(torch.rand(3), expected)
    _, again, _ = filled(policy, pipeline)
    assert torch.equal(first.raw_action, again.raw_action)
    other = RolloutBuffer(20, 16, "cpu")
    collect(Recorder(16, horizon=HORIZON), policy, pipeline, other, seed=4)
    here = torch.arange(16)
    noise, other_noise = (
        each.raw_action[0] - policy.select_action(each.observations.read(here)) for each in (first, other)
    )
    assert not torch.allclose(noise, other_noise, atol=1e-3)


class StillEnv(PointEnv):
    """Episodes never end, and nothing is asked of the device."""

    def step(self, action: Tensor) -> Any:
        never = torch.zeros(self.num_envs, dtype=torch.bool)
        return self._observe(), action.sum(dim=1), never, never, {"reward_parts": {"success": never}}


@pytest.mark.parametrize("chunk", [1, 3])
def test_no_step_of_a_rollout_waits_for_the_device(
    chunk: int, make_policy: Callable[..., CnnPolicy], pipeline: Pipeline
) -> None:
    policy: Any = make_policy() if chunk == 1 else ChunkPolicy(chunk)
    counts = []
    for steps in (3, 30):
        buffer = RolloutBuffer(steps, 4, "cpu")
        with ReadBacks() as found:
            collect(StillEnv(4), policy, pipeline, buffer, 0)
        counts.append(found.count)
    assert counts[0] == counts[1] > 0


class Moves(TorchDispatchMode):
    """Counts copies from one device to another."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, function: Any, types: Any, arguments: Any = (), named: Any = None) -> Any:
        result = function(*arguments, **(named or {}))
        moves = function is torch.ops.aten._to_copy.default and result.device != arguments[0].device
        self.count += moves
        return result


@pytest.mark.parametrize("chunk", [1, 3])
def test_to_ask_the_policy_nothing_is_moved_to_the_device_or_from_it(chunk: int, pipeline: Pipeline) -> None:
    """On PyTorch's device without memory, from which nothing can be fetched."""
    policy, buffer = ChunkPolicy(chunk).to("meta"), RolloutBuffer(7, 4, "meta")
    never = torch.zeros(4, dtype=torch.bool, device="meta")
    actor = Actor(policy, pipeline, buffer)
    observation = {"observation.state": torch.zeros(4, 4, device="meta"), "task": ["reach"] * 4}
    with Moves() as found:
        for step in range(7):
            buffer.observations.write(step, observation)
            assert actor.act(step).shape == (4, 3)
            actor.advance(never, any_finished=False)
    assert found.count == 0
    assert policy.asked == [4] * len(range(0, 7, chunk))
