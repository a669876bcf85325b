"""Structures and numbers of linux/videodev2.h that a camera needs; 64-bit kernels only.

Sizes are those of LP64 (x86-64, aarch64); a test holds them to the kernel's.
"""

from __future__ import annotations

import ctypes
from ctypes import c_int32, c_uint8, c_uint16, c_uint32, c_uint64

VIDEO_CAPTURE = 1
MEMORY_MMAP = 1
"""V4L2_BUF_TYPE_VIDEO_CAPTURE, V4L2_MEMORY_MMAP: pictures in buffers mapped from the kernel."""

CAP_VIDEO_CAPTURE = 0x00000001
CAP_STREAMING = 0x04000000
"""V4L2_CAP_*: the device takes pictures; it hands them over in such buffers."""
CAP_DEVICE_CAPS = 0x80000000
"""Set where ``device_caps`` describes this node alone."""

BUF_FLAG_ERROR = 0x0040
"""The picture may be damaged."""
BUF_FLAG_TIMESTAMP_MASK = 0xE000
BUF_FLAG_TIMESTAMP_MONOTONIC = 0x2000
"""The stamp is on CLOCK_MONOTONIC."""
BUF_FLAG_TSTAMP_SRC_MASK = 0x70000
BUF_FLAG_TSTAMP_SRC_SOE = 0x10000
"""The stamp is that of the start of exposure; without it, of the end of the frame."""

FRMSIZE_DISCRETE = 1
"""V4L2_FRMSIZE_TYPE_DISCRETE: one size, not a range of them."""

CID_AUTO_WHITE_BALANCE = 0x0098090C
CID_AUTOGAIN = 0x00980912
CID_GAIN = 0x00980913
CID_WHITE_BALANCE_TEMPERATURE = 0x0098091A
CID_EXPOSURE_AUTO = 0x009A0901
CID_EXPOSURE_ABSOLUTE = 0x009A0902
"""V4L2_CID_*: controls (linux/v4l2-controls.h)."""
EXPOSURE_MANUAL = 1
"""Value of CID_EXPOSURE_AUTO."""
EXPOSURE_UNIT_S = 100e-6
"""Unit of CID_EXPOSURE_ABSOLUTE."""


def fourcc(name: str) -> int:
    """``YUYV`` as the kernel writes it."""
    return int.from_bytes(name.encode("ascii"), "little")


def name_of(pixelformat: int) -> str:
    """The four letters that :func:`fourcc` made a number of."""
    return int(pixelformat).to_bytes(4, "little").decode("ascii", "replace")


class Capability(ctypes.Structure):
    """``struct v4l2_capability``."""

    _fields_ = (
        ("driver", ctypes.c_char * 16),
        ("card", ctypes.c_char * 32),
        ("bus_info", ctypes.c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class PixFormat(ctypes.Structure):
    """``struct v4l2_pix_format``."""

    _fields_ = tuple(
        (name, c_uint32)
        for name in (
            *("width", "height", "pixelformat", "field", "bytesperline", "sizeimage"),
            *("colorspace", "priv", "flags", "ycbcr_enc", "quantization", "xfer_func"),
        )
    )


class _FormatUnion(ctypes.Union):
    # The kernel's union holds pointers: it starts at a multiple of eight.
    _fields_ = (("pix", PixFormat), ("raw", c_uint8 * 200), ("_align", c_uint64))


class Format(ctypes.Structure):
    """``struct v4l2_format``."""

    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class Fraction(ctypes.Structure):
    """``struct v4l2_fract``."""

    _fields_ = (("numerator", c_uint32), ("denominator", c_uint32))


class StreamParameters(ctypes.Structure):
    """``struct v4l2_streamparm``."""

    _fields_ = (
        ("type", c_uint32),
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("timeperframe", Fraction),
        ("raw", c_uint8 * 184),
    )


class RequestBuffers(ctypes.Structure):
    """``struct v4l2_requestbuffers``."""

    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint32),
    )


class Buffer(ctypes.Structure):
    """``struct v4l2_buffer``."""

    planes: ctypes.Array[Plane]
    """What ``offset`` points to where a picture has several planes."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("seconds", ctypes.c_int64),
        ("microseconds", ctypes.c_int64),
        ("timecode", c_uint8 * 16),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        # A union: the lower half is the offset of memory-mapped buffers, or it is a pointer.
        ("offset", c_uint64),
        ("length", c_uint32),
        ("reserved", c_uint32 * 2),
    )


class V4l2Control(ctypes.Structure):
    """``struct v4l2_control``."""

    _fields_ = (("id", c_uint32), ("value", c_int32))


class QueryControl(ctypes.Structure):
    """``struct v4l2_queryctrl``."""

    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", ctypes.c_char * 32),
        ("minimum", c_int32),
        ("maximum", c_int32),
        ("step", c_int32),
        ("default_value", c_int32),
        ("flags", c_uint32),
        ("reserved", c_uint32 * 2),
    )


class FormatDescription(ctypes.Structure):
    """``struct v4l2_fmtdesc``."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", ctypes.c_char * 32),
        ("pixelformat", c_uint32),
        ("reserved", c_uint32 * 4),
    )


class FrameSize(ctypes.Structure):
    """``struct v4l2_frmsizeenum``."""

    _fields_ = (
        ("index", c_uint32),
        ("pixelformat", c_uint32),
        ("type", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("stepwise", c_uint32 * 4),
        ("reserved", c_uint32 * 2),
    )


def _request(
    direction: int, number: int, argument: type[ctypes._SimpleCData[int] | ctypes.Structure]
) -> int:
    """_IOR (2), _IOW (1) or _IOWR (3) of asm-generic/ioctl.h for type 'V'."""
    return direction << 30 | ctypes.sizeof(argument) << 16 | ord("V") << 8 | number


QUERYCAP = _request(2, 0, Capability)
ENUM_FMT = _request(3, 2, FormatDescription)
S_FMT = _request(3, 5, Format)
REQBUFS = _request(3, 8, RequestBuffers)
QUERYBUF = _request(3, 9, Buffer)
QBUF = _request(3, 15, Buffer)
DQBUF = _request(3, 17, Buffer)
STREAMON = _request(1, 18, c_int32)
STREAMOFF = _request(1, 19, c_int32)
S_PARM = _request(3, 22, StreamParameters)
G_CTRL = _request(3, 27, V4l2Control)
S_CTRL = _request(3, 28, V4l2Control)
QUERYCTRL = _request(3, 36, QueryControl)
ENUM_FRAMESIZES = _request(3, 74, FrameSize)
"""VIDIOC_*: requests of ioctl."""


# --------------------------------------------------------------------------------------------------
# Structures of linux/videodev2.h for pictures whose colours lie in memory of their own.
#
# The multi-planar API is the one of many boards' own cameras: rkisp, some Qualcomm and NXP drivers.
# A test holds the sizes to the kernel's.

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
