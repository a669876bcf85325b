"""The sizes of the scenes that `aquaflow lab bench render` draws."""

from __future__ import annotations

from aquaflow.render.example_scene import Size

COUNTS = (10_000, 30_000, 100_000, 300_000)
PICTURES = ((320, 240), (640, 480), (1280, 720))
SIZES = tuple(Size(n, *picture) for picture in PICTURES for n in COUNTS)
"""Numbers of Gaussians, sizes of pictures, and each with each."""
QUICK_SIZES = (Size(30_000, 320, 240), Size(100_000, 640, 480))
"""Those of the renderer's bars."""
