"""What exists in the simulator: objects, scenes, tasks, cameras, and the simulation itself."""
