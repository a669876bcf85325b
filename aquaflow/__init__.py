"""AquaFlow: onboard mapping for underwater robots from one camera.

Importing this package is cheap: torch, OpenCV and matplotlib load where they are used.
"""

__version__ = "0.1.0"

__all__ = ["__version__"]
