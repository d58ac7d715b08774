"""What the steps of studies run, and what collects their results."""
