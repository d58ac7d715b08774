"""The module LeRobot's plugin discovery imports (its name is the distribution's name).

It only imports configuration modules, so `lerobot-train --help` stays fast and a missing simulator
never hides a policy: heavy imports (torch models, mani_skill) happen when something is built.
"""

import importlib

CONFIGURATION_MODULES = (
    "lerobot_wmrl.world_models.configuration_frame_tokenizer",
    "lerobot_wmrl.world_models.configuration_world_model",
    "lerobot_wmrl.rewards.configuration_rewards",
    "lerobot_wmrl.envs.configuration_world_model",
    "lerobot_wmrl.envs.configuration_wmrl_maniskill",
    "lerobot_wmrl.rl.configuration_algorithms",
    "lerobot_policy_cnn.configuration_cnn",
    "lerobot_policy_openvla.configuration_openvla",
    "lerobot_policy_wm_mpc.configuration_wm_mpc",
)

for _name in CONFIGURATION_MODULES:
    importlib.import_module(_name)
