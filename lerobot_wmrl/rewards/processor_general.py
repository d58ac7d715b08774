"""Processors of the general reward: the shared pass-through."""

from lerobot_wmrl.world_models.processor_world_model import make_pass_through_processors

make_general_pre_post_processors = make_pass_through_processors
