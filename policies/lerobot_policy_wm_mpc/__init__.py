"""Model-predictive control inside a world model, as a LeRobot policy."""
