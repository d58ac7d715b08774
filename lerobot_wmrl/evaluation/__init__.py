"""How far a world model can be trusted: real episodes replayed open loop, measured, and drawn."""
