"""Motions planned in joint space with mplib."""

from lerobot_dataset_maniskill.planners.joint_space.numpy_slot import restore_copy_into

restore_copy_into()  # before any module here imports mplib, which looks the function up as it is imported
