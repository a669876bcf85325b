"""Mapping: Gaussians, the water between them and the camera, and their joint optimisation."""
