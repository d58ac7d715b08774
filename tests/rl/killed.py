"""A stand-in for `kill -9` in tests of resuming."""


class Killed(Exception):
    """Nothing that stands after it runs."""
