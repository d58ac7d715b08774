"""Processors of the rewards: none changes a batch, for the models normalise by themselves."""

from lerobot_wmrl.world_models.processor_world_model import make_pass_through_processors

make_general_pre_post_processors = make_pass_through_processors
make_proxy_pre_post_processors = make_pass_through_processors
make_embedding_pre_post_processors = make_pass_through_processors
