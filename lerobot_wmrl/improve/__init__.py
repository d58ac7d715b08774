"""One command from a policy and a dataset to a better policy: `lerobot-wmrl-improve`."""
