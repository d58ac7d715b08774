"""Planning inside a world model."""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from lerobot.scripts import lerobot_eval

from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_policy_wm_mpc import modeling_wm_mpc
from lerobot_policy_wm_mpc.configuration_wm_mpc import WmMpcConfig
from lerobot_policy_wm_mpc.modeling_wm_mpc import WmMpcPolicy
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.images import stretch
from lerobot_wmrl.common.policies import load_processors, read_policy_config
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH, ACTION_LOW
from lerobot_wmrl.world_models.autoregressive.configuration import AutoregressiveConfig
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.configuration_planner import PlannerSettings
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig
from lerobot_wmrl.world_models.planning import Planner, interpolate_knots, plan_knots, success_logit
from tests.rl.checkpoints import save_untrained_policy
from tests.trained import action_config, run_training, text_config

SMALL = {"horizon": 8, "execute": 3, "samples": 6, "elites": 2, "iterations": 2, "knots": 3, "device": "cpu"}
IMAGE = "observation.images.third_view"


def search(
    value: Callable[[torch.Tensor], torch.Tensor],
    mean: torch.Tensor,
    low: torch.Tensor,
    high: torch.Tensor,
    **settings: int,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Search from these knots (B, K, A), with deviations of 1."""
    sizes = {"samples": 64, "elites": 8, "iterations": 12, **settings}
    spread, generator = torch.ones(mean.shape[-1]), torch.Generator().manual_seed(0)
    return plan_knots(value, mean, spread, low, high, generator=generator, **sizes)


def test_the_planner_finds_the_sequence_that_is_wanted():
    wanted = torch.linspace(-0.5, 0.5, 12)[:, None].expand(-1, 2)

    def value(actions: torch.Tensor) -> torch.Tensor:
        return -(actions - wanted).square().sum((1, 2))

    low, high = torch.full((2,), -1.0), torch.ones(2)
    found, mean = search(value, torch.zeros(1, 4, 2), low, high, horizon=12)
    actions = interpolate_knots(found, 12)
    assert (actions[0] - wanted).abs().max() < 0.1
    assert (interpolate_knots(mean, 12)[0] - wanted).abs().max() < 0.1


def test_searches_at_once_find_what_each_wants():
    wanted = torch.tensor([-0.6, 0.0, 0.6])

    def value(actions: torch.Tensor) -> torch.Tensor:
        goal = wanted.repeat_interleave(len(actions) // 3)[:, None, None]
        return -(actions - goal).square().sum((1, 2))

    low, high = torch.full((1,), -1.0), torch.ones(1)
    found, _ = search(value, torch.zeros(3, 4, 1), low, high, horizon=8)
    assert (found - wanted[:, None, None]).abs().max() < 0.1


def test_the_planner_keeps_to_the_box_and_never_returns_worse_than_it_was_given():
    low, high = torch.tensor([-0.2]), torch.tensor([0.3])
    asked = []

    def value(actions: torch.Tensor) -> torch.Tensor:
        asked.append(actions)
        return ((actions - 0.1).abs() < 1e-6).all((1, 2)).float()

    mean = torch.full((2, 3, 1), 0.1)
    found, _ = search(value, mean, low, high, horizon=6, samples=16, elites=4, iterations=3)
    assert torch.equal(found, mean)
    assert torch.cat(asked).min() >= low - 1e-6
    assert torch.cat(asked).max() <= high + 1e-6


def test_where_all_is_equally_good_the_first_mean_is_kept_within_the_bounds():
    mean = torch.tensor([[[0.0], [2.0]]])
    found, _ = search(
        lambda actions: torch.zeros(len(actions)),
        mean,
        -torch.ones(1),
        torch.ones(1),
        horizon=4,
        samples=16,
        elites=4,
        iterations=3,
    )
    assert torch.equal(found, mean.clamp(max=1))


@pytest.mark.parametrize(("state", "shown"), [(None, "is missing"), (torch.zeros(1, 9), "has 9 components")])
def test_a_state_that_the_world_model_has_not_learnt_is_named(trained_models, state, shown):
    policy = WmMpcPolicy(WmMpcConfig(world_model_path=str(trained_models["action_world_model"]), **SMALL))
    batch = {IMAGE: torch.rand(1, 3, 32, 32), "task": ["push"]}
    if state is not None:
        batch["observation.state"] = state
    with pytest.raises(FieldError, match=rf"world_model_path=.*a state of 8 components, and .*state {shown}"):
        policy.select_action(batch)


def test_a_search_changes_the_proposed_actions_by_a_few_deviations(trained_models):
    """One sample is the proposal itself, at every step, not at knots alone."""
    model = load_model(trained_models["action_world_model"], "action_world_model").eval()
    proposed = 0.02 * torch.rand(2, 9, 7, generator=torch.Generator().manual_seed(0))
    frames = Frames(torch.zeros(2, model.tokenizer.tokens_per_frame, dtype=torch.long), torch.zeros(2, 8))
    low, high = torch.tensor(ACTION_LOW), torch.tensor(ACTION_HIGH)

    def plan(samples: int, spread: float) -> torch.Tensor:
        settings = PlannerSettings(
            horizon=9, execute=3, samples=samples, elites=1, iterations=1, knots=3, spread=spread
        )
        planner = Planner(model, None, settings, 2, averaged=True, low=low, high=high, seed=0)
        return planner.plan(frames, ["", ""], proposed)

    torch.testing.assert_close(plan(1, 1.0), proposed)
    moved = (plan(8, 0.1) - proposed).abs().amax((0, 1)) / model.action_std
    assert 0 < moved.max() < 0.5


def test_done_counts_as_long_as_it_holds():
    logits = torch.tensor([[9.0, -9, 9, -9, 9], [-9, 1, 2, 3, -9]])
    assert success_logit(logits, 3).tolist() == [-9, 1]


@pytest.mark.parametrize(("left", "best"), [(None, 1.0), (8, 1.0), (4, -1.0), (1, 0.0)])
def test_success_after_the_end_of_the_episode_does_not_count(left, best):
    """Positive actions succeed surely at the eighth step, negative ones less surely at the third.

    Where neither is in time, nothing is changed.
    """

    class Model(SimpleNamespace):
        def open_loop(self, frames, actions, with_tokens):
            logit, first = torch.full(actions.shape[:2], -9.0), actions[:, 0, 0]
            logit[first > 0, 6:] = 5.0
            logit[first < 0, 1:4] = 2.0
            return SimpleNamespace(done_logit=logit)

    model = Model(action_mean=torch.zeros(1), action_deviation=lambda: torch.ones(1))
    settings = PlannerSettings(horizon=8, execute=2, samples=32, elites=1, iterations=1, knots=1)
    bound = torch.ones(1)
    planner = Planner(model, None, settings, 2, averaged=False, low=-bound, high=bound, seed=0)
    plan = planner.plan([None], [""], torch.zeros(1, 8, 1), left)
    assert plan[0, 0, 0].sign() == best


@pytest.fixture
def config(trained_models) -> WmMpcConfig:
    return WmMpcConfig(
        world_model_path=str(trained_models["action_world_model"]),
        text_world_model_path=str(trained_models["text_world_model"]),
        **SMALL,
    )


def observation(small_dataset, rows: list[int]) -> dict:
    found = [small_dataset[row] for row in rows]
    names = (IMAGE, "observation.state")
    return {
        **{name: torch.stack([row[name] for row in found]) for name in names},
        "task": [row["task"] for row in found],
    }


@pytest.mark.parametrize("objective", ["success", "goal"])
def test_it_plans_anew_when_the_plan_is_carried_out(config, objective, small_dataset):
    config.objective = objective
    policy = WmMpcPolicy(config)
    plans = []
    predict = policy.predict_action_chunk
    policy.predict_action_chunk = lambda batch: plans.append(predict(batch)) or plans[-1]
    seen = observation(small_dataset, [0, 20])
    actions = torch.stack([policy.select_action(seen) for _ in range(2 * SMALL["execute"])])
    assert len(plans) == 2
    assert plans[0].shape == (2, SMALL["horizon"], 7)
    carried_out = torch.cat([plan[:, : SMALL["execute"]] for plan in plans], 1).transpose(0, 1)
    assert torch.equal(actions, carried_out)
    assert (actions >= torch.tensor(ACTION_LOW) - 1e-6).all()
    assert (actions <= torch.tensor(ACTION_HIGH) + 1e-6).all()
    assert torch.allclose(actions[..., -1], torch.tensor(-1.0))  # the gripper's action never varied


def test_the_goal_may_depend_on_a_state_that_the_action_world_model_has_not(
    trained_models, small_dataset, tmp_path
):
    tokenizer, root = trained_models["frame_tokenizer"], Path(small_dataset.root)
    folders = {size: tmp_path / str(size) for size in (0, 8)}
    for size, folder in folders.items():
        make = text_config if size else action_config
        run_training(make(tokenizer, state_size=size or 0), root, folder)
    config = WmMpcConfig(
        world_model_path=str(folders[0]), text_world_model_path=str(folders[8]), objective="goal", **SMALL
    )
    plan = WmMpcPolicy(config).predict_action_chunk(observation(small_dataset, [0, 20]))
    assert plan.shape == (2, SMALL["horizon"], 7)
    seen = observation(small_dataset, [0, 20])
    del seen["observation.state"]
    with pytest.raises(ValueError, match=r"^text_world_model_path=.* a state of 8 components, .* is missing"):
        WmMpcPolicy(config).predict_action_chunk(seen)


def test_episodes_that_begin_alike_are_planned_alike(config, small_dataset):
    policy, seen = WmMpcPolicy(config), observation(small_dataset, [0])
    first = policy.predict_action_chunk(seen)
    assert not torch.equal(policy.predict_action_chunk(seen), first)
    policy.reset()
    assert torch.equal(policy.predict_action_chunk(seen), first)


def test_lerobot_eval_runs_it_in_imagination(config, trained_models, small_dataset, tmp_path, monkeypatch):
    given = [f"--policy.{name}={value}" for name, value in SMALL.items()]
    path = trained_models["action_world_model"]
    monkeypatch.setattr(
        sys,
        "argv",
        [
            "lerobot-eval",
            "--policy.type=wm_mpc",
            f"--policy.world_model_path={path}",
            *given,
            "--env.type=world_model",
            f"--env.world_model_path={path}",
            "--env.reward.type=general",
            "--env.reward.alpha=1",
            f"--env.dataset.root={Path(small_dataset.root)}",
            "--env.episode_length=5",
            "--eval.n_episodes=2",
            "--eval.batch_size=2",
            f"--output_dir={tmp_path}",
        ],
    )
    lerobot_eval.main()
    found = json.loads((tmp_path / "eval_info.json").read_text())
    assert len(found["per_task"][0]["metrics"]["successes"]) == 2


def test_bad_settings_name_the_field_and_the_remedy(trained_models):
    path = str(trained_models["action_world_model"])
    with pytest.raises(ValueError, match=r"^world_model_path=: is missing"):
        WmMpcPolicy(WmMpcConfig(device="cpu"))
    with pytest.raises(ValueError, match=r"^text_world_model_path=: .*`objective` to success"):
        WmMpcPolicy(WmMpcConfig(device="cpu", world_model_path=path, objective="goal"))
    with pytest.raises(ValueError, match=r"^objective=reward: choose"):
        WmMpcConfig(device="cpu", objective="reward")
    with pytest.raises(ValueError, match=r"^elites=9: must be at most `samples`, 4"):
        WmMpcConfig(device="cpu", elites=9, samples=4)
    with pytest.raises(ValueError, match=r"^knots=1: must be from 2"):
        WmMpcConfig(device="cpu", knots=1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"learnt_successes": 0}, "has learnt from no successful episode"),
        ({"dynamics": AutoregressiveConfig(depth=True)}, "looks at depth, which environments do not show"),
    ],
)
def test_a_world_model_in_which_nothing_can_be_planned_is_refused(config, settings, message, monkeypatch):
    class Loaded:
        config = ActionWorldModelConfig(**settings)

    monkeypatch.setattr(modeling_wm_mpc, "load_model", lambda *_: Loaded())
    with pytest.raises(ValueError, match=rf"^world_model_path=.*: {message}"):
        WmMpcPolicy(config)


def test_without_a_search_it_does_what_the_other_policy_does_in_imagination(config, small_dataset, tmp_path):
    """There are fewer knots than steps, and still every action is the policy's."""
    config.samples = config.elites = config.iterations = 1
    config.proposal_path = str(save_untrained_policy(tmp_path, actions=7))
    planning, seen = WmMpcPolicy(config), observation(small_dataset, [0, 20])
    plan = planning.predict_action_chunk(seen)

    policy, model = CnnPolicy.from_pretrained(tmp_path).eval(), planning.planner.model
    before, after = load_processors(read_policy_config(str(tmp_path), ["--device=cpu"]))
    low, high = torch.tensor(ACTION_LOW), torch.tensor(ACTION_HIGH)
    images, state, actions = seen[IMAGE][:, None], seen["observation.state"], []
    context = model.tokenizer.context(images)
    imagination = model.start(Frames(model.tokenizer.encode(images, context), state, context))
    for _ in range(config.horizon):
        batch = before({IMAGE: images[:, 0], "observation.state": state, "task": seen["task"]})
        actions.append(after(policy.select_action(batch)).clamp(low, high))
        imagined = model.step(imagination, actions[-1])
        images, state = model.decode(imagined.tokens, context).images, imagined.state
    torch.testing.assert_close(plan, torch.stack(actions, 1), atol=1e-4, rtol=0)
    assert not torch.allclose(plan[0], plan[1])

    fine = torch.rand(2, 3, 64, 64)  # finer than the dataset's frames, of which the policy has seen no others
    for size in (32, 64):
        model.config.tokenizer = replace(model.config.tokenizer, frame_sizes=[[size, size]])
        planning.reset()
        first = planning.predict_action_chunk({**seen, IMAGE: fine})[:, 0]
        policy.reset()
        shown = {**seen, IMAGE: stretch(fine, size, size)}
        expected = after(policy.select_action(before(shown))).clamp(low, high)
        torch.testing.assert_close(first, expected)


def test_a_policy_that_looks_at_something_else_proposes_nothing(config, tmp_path):
    config.proposal_path = str(save_untrained_policy(tmp_path, camera="wrist", actions=7))
    with pytest.raises(
        ValueError,
        match=r"^proposal_path=.*needs observation\.images\.wrist.*train the policy on what this one shows",
    ):
        WmMpcPolicy(config)
    config.proposal_path = str(tmp_path / "nothing")
    with pytest.raises(ValueError, match=r"^proposal_path=.*no checkpoint there.*give the output folder"):
        WmMpcPolicy(config)


def test_a_plan_goes_on_where_it_was_carried_out(trained_models):
    model = load_model(trained_models["action_world_model"], "action_world_model")
    settings = PlannerSettings(horizon=8, execute=3, samples=6, elites=2, iterations=1, knots=8)
    low, high = model.action_range()
    planner = Planner(model, None, settings, done_frames=1, averaged=False, low=low, high=high, seed=0)
    plan = torch.arange(8.0)[None, :, None].expand(1, 8, 7)
    assert planner._remaining_knots(plan)[0, :, 0].tolist() == [3, 4, 5, 6, 7, 7, 7, 7]
