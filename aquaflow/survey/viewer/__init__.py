"""The viewer of a dive: splats, trajectory, camera and health in a browser."""
