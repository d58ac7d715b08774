"""The report of an improvement: what was found, learnt and gained, with intervals, pictures and commands."""
