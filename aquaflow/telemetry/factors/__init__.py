"""What each kind of telemetry says about the map's frame: one residual for each."""
