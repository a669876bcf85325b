"""Pixels of messages in every encoding that cameras of ROS send, against the same plain picture."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.recordings.picture import UnreadablePictureError, to_rgb
from aquaflow.recordings.picture_message import raw_picture

H, W = 24, 32
BAYER = {"bayer_rggb": (0, 1, 1, 2), "bayer_bggr": (2, 1, 1, 0)}
"""Channel of the four pixels of a cell: red, green, blue."""
NEAR = 4
"""Grey levels that the way by YUV, or from a mosaic of an even patch, may cost."""


def picture() -> npt.NDArray[np.uint8]:
    """[H, W, 3] RGB: two halves of plain colours, all channels different."""
    plain = np.empty((H, W, 3), np.uint8)
    plain[:, : W // 2], plain[:, W // 2 :] = (200, 90, 30), (20, 120, 160)
    return plain


def stored(name: str, wide: str = "<u2") -> npt.NDArray[np.generic]:
    """The picture as a camera would send it, without padding."""
    rgb = picture()
    sixteen = name.endswith("16") or name.startswith("16UC")
    numbers = (rgb.astype(np.uint16) * 256).astype(wide) if sixteen else rgb
    layout = name.lower().replace("8uc3", "bgr8").replace("16uc3", "bgr16").replace("8uc4", "bgra8")
    if layout.startswith("bayer"):
        cell = BAYER[layout.rstrip("816")]
        mosaic = np.empty((H, W), numbers.dtype)
        for k, channel in enumerate(cell):
            mosaic[k // 2 :: 2, k % 2 :: 2] = numbers[k // 2 :: 2, k % 2 :: 2, channel]
        return mosaic
    if layout in ("nv12", "nv21"):
        planes = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420)
        u, v = planes[H:].reshape(2, H // 2, W // 2)
        pair = (u, v) if layout == "nv12" else (v, u)
        return np.concatenate([planes[:H], np.stack(pair, axis=2).reshape(H // 2, W)])
    if layout in ("yuv422", "uyvy", "yuv422_yuy2", "yuyv"):
        order = "UYVY" if layout in ("yuv422", "uyvy") else "YUY2"
        return np.asarray(cv2.cvtColor(rgb, getattr(cv2, f"COLOR_RGB2YUV_{order}")))
    ordered = numbers[..., ::-1] if layout.startswith("bgr") else numbers
    if "a" in layout:
        opaque = np.full((H, W, 1), np.iinfo(ordered.dtype).max, ordered.dtype)
        ordered = np.concatenate([ordered, opaque], axis=2)
    return np.ascontiguousarray(ordered)


@pytest.mark.parametrize(
    "name",
    [
        *("rgb8", "bgr8", "rgba8", "bgra8", "8UC3", "8UC4", "rgb16", "bgr16", "rgba16", "bgra16"),
        *("16UC3", "bayer_rggb8", "bayer_bggr8", "bayer_rggb16", "nv12", "nv21", "yuv422", "uyvy"),
        *("UYVY", "yuv422_yuy2", "yuyv"),
    ],
)
def test_every_encoding_gives_the_same_picture(name: str) -> None:
    data = stored(name)
    step = data.shape[1] * data[0, 0].nbytes
    found = to_rgb(raw_picture(data.tobytes(), H, W, step, name), 1 << 16)
    assert found.shape == (H, W, 3)
    inner = np.s_[4:-4, [*range(4, W // 2 - 4), *range(W // 2 + 4, W - 4)]]
    assert np.abs(found[inner].astype(int) - picture()[inner]).max() <= NEAR


@pytest.mark.parametrize("name", ["mono16", "16UC1", "rgb16", "bayer_rggb16"])
def test_the_order_of_bytes_is_that_of_the_message(name: str) -> None:
    if name in ("mono16", "16UC1"):
        small = [(picture()[..., 0].astype(np.uint16) * 256).astype(way) for way in ("<u2", ">u2")]
    else:
        small = [stored(name, way) for way in ("<u2", ">u2")]
    step = small[0].shape[1] * small[0][0, 0].nbytes
    little = raw_picture(small[0].tobytes(), H, W, step, name)
    big = raw_picture(small[1].tobytes(), H, W, step, name, big_endian=True)
    np.testing.assert_array_equal(little, big)
    assert to_rgb(little, 1 << 16)[H // 2, 4, 0] == 200


@pytest.mark.parametrize(("name", "words"), [("jade12", "encoding 'jade12'"), ("rgb8", "fewer")])
def test_what_cannot_be_read_is_named(name: str, words: str) -> None:
    with pytest.raises(UnreadablePictureError, match=words):
        raw_picture(b"\x00" * 100, H, W, 3 * W, name)
