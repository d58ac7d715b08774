"""Rewards of imagined and simulated episodes: the general reward, learned ones, LeRobot's own."""
