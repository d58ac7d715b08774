"""What this project imports from LeRobot outside its documented API."""

import ast
import importlib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("lerobot_wmrl", "policies", "datasets", "robots")

DOCUMENTED = {
    "lerobot.configs",
    "lerobot.configs.policies",
    "lerobot.configs.rewards",
    "lerobot.configs.types",
    "lerobot.datasets.lerobot_dataset",
    "lerobot.envs",
    "lerobot.envs.configs",
    "lerobot.optim",
    "lerobot.policies.pretrained",
    "lerobot.processor",
    "lerobot.rewards.pretrained",
    "lerobot.robots",
    "lerobot.utils.constants",
}
"""Modules that LeRobot's guides to policies, environments, processors, datasets and robots tell plugins to
import."""

UNDOCUMENTED = {
    "lerobot.common.wandb_utils": {"WandBLogger"},
    "lerobot.configs.default": {"PeftConfig", "WandBConfig"},
    "lerobot.configs.video": {
        "DEPTH_METER_UNIT",
        "DepthEncoderConfig",
        "RGBEncoderConfig",
        "infer_depth_unit",
    },
    "lerobot.datasets.aggregate": {"aggregate_datasets"},
    "lerobot.datasets.dataset_metadata": {"CODEBASE_VERSION", "LeRobotDatasetMetadata"},
    "lerobot.datasets.dataset_tools": {"add_features", "remove_feature"},
    "lerobot.datasets.depth_utils": {"MM_PER_METRE", "dequantize_depth"},
    "lerobot.datasets.factory": {"resolve_delta_timestamps"},
    "lerobot.datasets.io_utils": {"load_info", "write_info"},
    "lerobot.datasets.utils": {"EPISODES_DIR", "BackwardCompatibilityError"},
    "lerobot.datasets.video_utils": {"FrameTimestampError", "decode_video_frames"},
    "lerobot.envs.utils": {
        "NEW_ROLLOUT_OPTION",
        "FreezeAfterEpisodeEnd",
        "env_to_policy_features",
        "preprocess_observation",
    },
    "lerobot.optim.optimizers": {"AdamWConfig"},
    "lerobot.optim.schedulers": {"CosineDecayWithWarmupSchedulerConfig", "LRSchedulerConfig"},
    "lerobot.policies.factory": {"get_policy_class", "make_pre_post_processors"},
    "lerobot.rewards.factory": {
        "get_reward_model_class",
        "make_reward_model",
        "make_reward_pre_post_processors",
    },
    "lerobot.rl.algorithms.base": {"RLAlgorithm"},
    "lerobot.rl.algorithms.configs": {"RLAlgorithmConfig", "TrainingStats"},
    "lerobot.scripts.lerobot_eval": {"eval_policy", "rollout"},
    "lerobot.utils.import_utils": {"register_third_party_plugins"},
    "lerobot.utils.keyboard_input": {"apply_recording_control"},
    "lerobot.utils.logging_utils": {"MetricsTracker"},
    "lerobot.utils.random_utils": {
        "deserialize_rng_state",
        "get_rng_state",
        "seeded_context",
        "serialize_rng_state",
        "set_rng_state",
        "set_seed",
    },
    "lerobot.utils.utils": {"SuppressProgressBars", "flatten_dict", "init_logging"},
}
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
