"""What exists in the simulator: objects, scenes, tasks, cameras."""
