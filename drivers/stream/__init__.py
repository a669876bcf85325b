"""Video streams from the network, through OpenCV's FFmpeg."""

from aquaflow.drivers.stream.camera import StreamCamera

__all__ = ["StreamCamera"]
