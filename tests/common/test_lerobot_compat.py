"""Training states that are ours, and what this project imports from LeRobot outside its documented API."""

import ast
import importlib
from pathlib import Path

import pytest
import torch
from lerobot.utils.random_utils import set_seed

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.lerobot_compat import (
    checkpoint_dir,
    gather_random_states,
    load_training_state,
    save_training_state,
    should_save_checkpoint,
)

ROOT = Path(__file__).parents[2]
PACKAGES = ("lerobot_wmrl", "policies", "datasets", "robots")

DOCUMENTED = {
    "lerobot.configs", "lerobot.configs.policies", "lerobot.configs.rewards", "lerobot.configs.types",
    "lerobot.datasets.lerobot_dataset", "lerobot.envs", "lerobot.envs.configs", "lerobot.optim",
    "lerobot.policies.pretrained", "lerobot.processor", "lerobot.rewards.pretrained", "lerobot.robots",
    "lerobot.utils.constants",
}  # fmt: skip
"""Modules that LeRobot's guides to policies, environments, processors, datasets and robots tell plugins to
import."""

UNDOCUMENTED = {
    "lerobot.common.wandb_utils": {"WandBLogger"},
    "lerobot.configs.default": {"PeftConfig", "WandBConfig"},
    "lerobot.configs.video": {
        "DEPTH_METER_UNIT", "DepthEncoderConfig", "RGBEncoderConfig", "infer_depth_unit",
    },
    "lerobot.datasets.aggregate": {"aggregate_datasets"},
    "lerobot.datasets.dataset_metadata": {"CODEBASE_VERSION"},
    "lerobot.datasets.dataset_tools": {"add_features", "remove_feature"},
    "lerobot.datasets.depth_utils": {"MM_PER_METRE", "dequantize_depth"},
    "lerobot.datasets.factory": {"resolve_delta_timestamps"},
    "lerobot.datasets.io_utils": {"load_info", "write_info"},
    "lerobot.datasets.utils": {"EPISODES_DIR", "BackwardCompatibilityError"},
    "lerobot.datasets.video_utils": {"decode_video_frames"},
    "lerobot.envs.utils": {
        "NEW_ROLLOUT_OPTION", "FreezeAfterEpisodeEnd", "env_to_policy_features", "preprocess_observation",
    },
    "lerobot.optim.optimizers": {"AdamWConfig"},
    "lerobot.optim.schedulers": {"CosineDecayWithWarmupSchedulerConfig", "LRSchedulerConfig"},
    "lerobot.policies.factory": {"get_policy_class", "make_pre_post_processors"},
    "lerobot.rewards.factory": {
        "get_reward_model_class", "make_reward_model", "make_reward_pre_post_processors",
    },
    "lerobot.rl.algorithms.base": {"RLAlgorithm"},
    "lerobot.rl.algorithms.configs": {"RLAlgorithmConfig", "TrainingStats"},
    "lerobot.scripts.lerobot_eval": {"eval_policy", "eval_policy_all", "rollout"},
    "lerobot.utils.import_utils": {"register_third_party_plugins"},
    "lerobot.utils.keyboard_input": {"apply_recording_control"},
    "lerobot.utils.logging_utils": {"MetricsTracker"},
    "lerobot.utils.random_utils": {
        "deserialize_rng_state", "get_rng_state", "serialize_rng_state", "set_rng_state", "set_seed",
    },
    "lerobot.utils.utils": {"flatten_dict", "init_logging"},
}  # fmt: skip
"""May change with any release: whoever adds one writes it down, and whoever raises the version reads this."""


def undocumented_imports() -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                module = node.module or "" if isinstance(node, ast.ImportFrom) else ""
                if module.partition(".")[0] == "lerobot" and module not in DOCUMENTED:
                    assert isinstance(node, ast.ImportFrom)
                    found.setdefault(module, set()).update(alias.name for alias in node.names)
    return found


def test_what_is_imported_from_lerobot_outside_its_documented_api_is_listed() -> None:
    assert undocumented_imports() == UNDOCUMENTED
    for module, names in UNDOCUMENTED.items():
        for name in names:
            assert hasattr(importlib.import_module(module), name), f"{module}.{name}"


def learn(
    model: torch.nn.Module, optimizer: torch.optim.Optimizer, scheduler: torch.optim.lr_scheduler.LRScheduler
) -> None:
    optimizer.zero_grad()
    model(torch.randn(4, 3)).square().sum().backward()
    optimizer.step()
    scheduler.step()


def make() -> tuple[torch.nn.Module, torch.optim.Optimizer, torch.optim.lr_scheduler.LRScheduler]:
    set_seed(0)
    model = torch.nn.Linear(3, 2)
    optimizer = torch.optim.AdamW(model.parameters(), lr=0.1)
    return model, optimizer, torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 0.9**step)


def test_a_training_continues_bit_for_bit(tmp_path: Path) -> None:
    model, optimizer, scheduler = make()
    for _ in range(3):
        learn(model, optimizer, scheduler)
    save_training_state(tmp_path, 3, gather_random_states(), optimizer, scheduler)
    weights = {name: value.clone() for name, value in model.state_dict().items()}
    learn(model, optimizer, scheduler)
    again, optimizer_again, scheduler_again = make()
    again.load_state_dict(weights)
    set_seed(5)
    assert load_training_state(tmp_path, optimizer_again, scheduler_again) == 3
    learn(again, optimizer_again, scheduler_again)
    assert torch.equal(again.weight, model.weight)
    assert scheduler_again.get_last_lr() == scheduler.get_last_lr()


def test_another_number_of_processes_and_a_missing_state_are_named(tmp_path: Path) -> None:
    _, optimizer, _ = make()
    folder = tmp_path / "checkpoints" / "000001"
    with pytest.raises(ValueError, match=r"training_state\.pt: cannot be read .*an earlier version"):
        load_training_state(folder, optimizer)
    save_training_state(folder, 1, 2 * gather_random_states(), optimizer)
    with pytest.raises(FieldError, match=r"began with 2 processes, here are 1; .*--nproc_per_node=2"):
        load_training_state(folder, optimizer)


def test_checkpoints_are_named_and_due_as_lerobots() -> None:
    assert checkpoint_dir(Path("run"), 500, 20_000) == Path("run/checkpoints/000500")
    assert checkpoint_dir(Path("run"), 500, 10**7).name == "00000500"
    assert [step for step in range(1, 8) if should_save_checkpoint(step, 3, 7)] == [3, 6, 7]
