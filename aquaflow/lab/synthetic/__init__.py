"""Synthetic dives: a procedural sea floor seen through known water, with the truth about it all."""
