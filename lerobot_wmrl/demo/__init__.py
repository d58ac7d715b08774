"""The whole loop as a demonstration: a policy from nothing, and its improvement."""
