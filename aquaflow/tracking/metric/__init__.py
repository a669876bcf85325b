"""Metres, gravity and north for keyframes and sub-maps."""
