"""Structures of linux/videodev2.h for pictures whose colours lie in memory of their own.

The multi-planar API is the one of many boards' own cameras: rkisp, some Qualcomm and NXP drivers. A
test holds the sizes to the kernel's.
"""

from __future__ import annotations

import ctypes
from ctypes import c_uint8, c_uint16, c_uint32, c_uint64

VIDEO_CAPTURE_MPLANE = 9
"""V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE."""
CAP_VIDEO_CAPTURE_MPLANE = 0x00001000
"""V4L2_CAP_VIDEO_CAPTURE_MPLANE."""
MAX_PLANES = 8
"""VIDEO_MAX_PLANES."""


class PlanePixFormat(ctypes.Structure):
    """``struct v4l2_plane_pix_format``."""

    _fields_ = (("sizeimage", c_uint32), ("bytesperline", c_uint32), ("reserved", c_uint16 * 6))


class PixFormatMplane(ctypes.Structure):
    """``struct v4l2_pix_format_mplane``."""

    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("colorspace", c_uint32),
        ("plane_fmt", PlanePixFormat * MAX_PLANES),
        ("num_planes", c_uint8),
        ("rest", c_uint8 * 11),
    )


class Plane(ctypes.Structure):
    """``struct v4l2_plane``."""

    _fields_ = (
        ("bytesused", c_uint32),
        ("length", c_uint32),
        ("offset", c_uint64),  # a union; its lower half is the offset of memory-mapped buffers
        ("data_offset", c_uint32),
        ("reserved", c_uint32 * 11),
    )
