"""USB and CSI cameras through the kernel's V4L2 interface, without a library."""

from aquaflow.drivers.v4l2.capture import V4l2Camera

__all__ = ["V4l2Camera"]
