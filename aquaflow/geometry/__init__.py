"""Rotations, similarities, cameras and alignment: numpy, float64, no I/O beyond calibration."""
