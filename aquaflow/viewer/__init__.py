"""The window into a dive: splats, trajectory, camera and health in a browser."""
