"""What others read: PLY maps, TUM trajectories, the report."""
