"""Telemetry and camera together: metres, gravity, north, depth, time."""
