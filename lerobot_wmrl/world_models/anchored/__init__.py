"""Anchored dynamics: an episode's first frame and the actions since give every later frame (eq. 1)."""
