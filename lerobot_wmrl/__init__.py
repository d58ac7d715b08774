"""World models for LeRobot: imagine a robot's next observation, reward and done, and train policies inside.

Importing any part of this package registers its policies, reward models, environments and algorithms with
LeRobot. Only their configurations are imported for that: models and the simulator load when one is built.

Letters in the shapes that docstrings give:
B batch (environments), T time (frames), N cameras, S tokens a frame, C channels or code factors,
D model width, H image height, W image width, A action size, P size of the robot's state, V logits of a token
(the levels of all its factors).
"""

from importlib import import_module

from lerobot_wmrl.common.stored_help import answer_help

answer_help()

CONFIGURATIONS = (
    "lerobot.rewards",  # LeRobot's own reward models, which an environment may take
    "lerobot_wmrl.world_models.configuration_frame_tokenizer",
    "lerobot_wmrl.world_models.configuration_world_model",
    "lerobot_wmrl.world_models.autoregressive.configuration",
    "lerobot_wmrl.rewards.configuration_rewards",
    "lerobot_wmrl.envs.configuration_hub",
    "lerobot_wmrl.envs.configuration_world_model",
    "lerobot_wmrl.envs.configuration_wmrl_maniskill",
    "lerobot_wmrl.rl.configuration_algorithms",
    "lerobot_wmrl.rl.configuration_grpo",
    "lerobot_wmrl.rl.configuration_distillation",
    "lerobot_policy_cnn.configuration_cnn",
    "lerobot_policy_openvla.configuration_openvla",
    "lerobot_policy_wm_mpc.configuration_wm_mpc",
    "lerobot_robot_imagined.config_imagined",
)

for _module in CONFIGURATIONS:
    import_module(_module)

import_module("lerobot_wmrl.common.dataset_schemas").set_columns_one_by_one()
