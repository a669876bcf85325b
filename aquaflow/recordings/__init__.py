"""Whatever a person has on disk becomes pictures, times, calibration and telemetry."""
