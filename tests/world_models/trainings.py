"""Trains what its arguments say, one model after another; for `torchrun`, whose processes start slowly.

Every argument is a JSON list of the flags of one `lerobot-wmrl-train-world-model`.
"""

import json
import sys
from datetime import timedelta

import draccus
from accelerate import PartialState

import lerobot_env_wmrl  # noqa: F401  (registers the models)
from lerobot_wmrl.scripts.train_world_model import TrainWorldModelConfig, train_world_model

PartialState(cpu=True, timeout=timedelta(minutes=4))  # for a process to wait for the other
for flags in sys.argv[1:]:
    train_world_model(draccus.parse(TrainWorldModelConfig, args=json.loads(flags)))
