"""The simulated instruments of a dive, and the file of their samples."""

from aquaflow.recordings.sample_table import HEADER, read_telemetry, write_telemetry

__all__ = ["HEADER", "read_telemetry", "write_telemetry"]
