"""Burned-in overlays (clock, crosshair, logo): found by themselves and masked."""
