"""Rollouts, advantage estimation, PPO and the trainer around them."""
