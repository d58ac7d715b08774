"""Processors of the learned rewards: the shared pass-through."""

from lerobot_wmrl.world_models.processor_world_model import make_pass_through_processors

make_proxy_pre_post_processors = make_pass_through_processors
make_embedding_pre_post_processors = make_pass_through_processors
