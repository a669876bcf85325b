"""Telemetry meets the map: device clocks, metric scale, gravity, velocity."""
