"""Command line, presets, errors, checkpoints, tracking, statistics: shared by every command."""
