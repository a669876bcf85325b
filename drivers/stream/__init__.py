"""Video streams from the network, through OpenCV's FFmpeg."""

from aquaflow.drivers.stream.rtp_capture import StreamCamera

__all__ = ["StreamCamera"]
