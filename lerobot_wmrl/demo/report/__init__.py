"""The demo's page: what was measured, with intervals, pictures and the commands that made it."""
