"""A small image policy: convolutions, a Gaussian head and a value head (method: the paper's image MLP)."""
