"""Autoregressive dynamics, the paper's: each frame from those before it (eq. 1), in imagination its own."""
