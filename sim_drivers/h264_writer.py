"""H.264 without an encoder: pictures of macroblocks that hold their samples as they are (I_PCM).

Every picture is a key frame of the baseline profile with its parameters before it, as simulated
cameras send them (ITU-T H.264, 7.3). Nothing is compressed, so the pictures have to be small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

BLOCK = 16
"""Pixels of a macroblock's side; a picture is a whole number of them wide and high."""
I_PCM = 25
"""mb_type of a macroblock in an I slice that holds its samples (Table 7-11)."""
START = b"\0\0\0\1"
"""Start code of a unit in a byte stream (Annex B)."""
SPS, PPS, IDR = 0x67, 0x68, 0x65
"""First bytes of the units: a sequence's parameters, a picture's parameters, a key frame."""


def access_unit(
    image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    number: int,
) -> bytes:
    """Picture ``number`` as a byte stream (Annex B) that can be decoded by itself."""
    return b"".join(START + unit for unit in units(image, number))


def units(
    image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    number: int,
) -> list[bytes]:
    """The units (NAL) of picture ``number``: two of parameters, and the picture."""
    height, width = image.shape[:2]
    if height % BLOCK or width % BLOCK:
        raise ValueError(f"{width} x {height} px are no whole macroblocks")
    return [
        _unit(SPS, _sequence_parameters(width // BLOCK, height // BLOCK)),
        _unit(PPS, _picture_parameters()),
        bytes([IDR]) + _slice(image, number),
    ]


class _Bits:
    """Writes fields of bits, the first in the highest place."""

    def __init__(self) -> None:
        self._bits = ""

    def write_bits(self, value: int, count: int) -> _Bits:
        """u(n)."""
        self._bits += f"{value:0{count}b}"
        return self

    def golomb(self, *values: int) -> _Bits:
        """ue(v): the value plus one, after as many zeros as it has further bits (9.1)."""
        for value in values:
            code = f"{value + 1:b}"
            self._bits += "0" * (len(code) - 1) + code
        return self

    def to_bytes(self, end: str) -> bytes:
        """Padded with ``end`` and zeros."""
        bits = self._bits + end
        bits += "0" * (-len(bits) % 8)
        return int(bits, 2).to_bytes(len(bits) // 8, "big")


def _sequence_parameters(columns: int, rows: int) -> bytes:
    """seq_parameter_set_data of the baseline profile, level 3.1, without reordering."""
    bits = _Bits().write_bits(66, 8).write_bits(0xC0, 8).write_bits(31, 8)
    # id, log2_max_frame_num - 4, pic_order_cnt_type, reference frames; then no gaps.
    bits.golomb(0, 0, 2, 1).write_bits(0, 1).golomb(columns - 1, rows - 1)
    # Frames only, direct 8x8 inference, no cropping, no usability information.
    return bits.write_bits(0b1100, 4).to_bytes("1")


def _picture_parameters() -> bytes:
    """pic_parameter_set_rbsp: CAVLC, one slice group, no deblocking to speak of."""
    bits = _Bits().golomb(0, 0).write_bits(0, 2).golomb(0, 0, 0).write_bits(0, 3)
    return bits.golomb(0, 0, 0).write_bits(0, 3).to_bytes("1")


def _slice(
    image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    number: int,
) -> bytes:
    """A key frame's only slice."""
    header = _Bits().golomb(0, 7, 0).write_bits(0, 4).golomb(number % 2).write_bits(0, 2).golomb(0)
    first = header.golomb(I_PCM).to_bytes("")
    blocks = _blocks(image)
    between = np.frombuffer(_Bits().golomb(I_PCM).to_bytes(""), np.uint8)
    rest = np.concatenate([np.tile(between, (len(blocks), 1)), blocks], axis=1)
    stop = b"\x80"
    return _escape(first) + rest.tobytes()[len(between) :] + stop


def _blocks(
    image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
) -> npt.NDArray[np.uint8]:
    """[macroblocks, 384] samples: 16 x 16 of Y, 8 x 8 of Cb and of Cr; none of them is 0."""
    import cv2

    height, width = image.shape[:2]
    planes = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420), np.uint8).reshape(-1)
    luma = planes[: height * width].reshape(height, width)
    chroma = planes[height * width :].reshape(2, height // 2, width // 2)
    parts = [_tiles(luma, BLOCK), *(_tiles(plane, BLOCK // 2) for plane in chroma)]
    # Without zeros, no start code is among the samples.
    return np.maximum(np.concatenate(parts, axis=1), 1)


def _tiles(
    plane: npt.NDArray[np.uint8],  # [H, W]
    side: int,
) -> npt.NDArray[np.uint8]:
    """[H / side * W / side, side * side], row by row."""
    height, width = plane.shape
    rows = plane.reshape(height // side, side, width // side, side)
    return rows.transpose(0, 2, 1, 3).reshape(-1, side * side)


def _unit(kind: int, payload: bytes) -> bytes:
    return bytes([kind]) + _escape(payload)


def _escape(payload: bytes) -> bytes:
    """With emulation_prevention_three_byte wherever a start code could be seen (7.4.1)."""
    escaped = bytearray()
    for byte in payload:
        if byte <= 3 and escaped[-2:] == b"\0\0":
            escaped.append(3)
        escaped.append(byte)
    return bytes(escaped)


# --------------------------------------------------------------------------------------------------
# Pictures as the bytes that a simulated V4L2 camera delivers.

JPEG_QUALITY = 95
"""Percent, OpenCV's own default."""

ROW_BYTES = {"YUYV": 2, "UYVY": 2, "GREY": 1, "NV12": 1, "NM12": 1}
"""For each pixel of a row."""
HALF_COLOURED = ("NV12", "NM12")
"""Half as many rows of colours follow; NM12's lie in memory of their own."""

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class PixelFormat:
    """What S_FMT settled on."""

    pixels: str
    width: int
    height: int
    padding: int
    """Bytes after each row that is not compressed."""

    @property
    def stride(self) -> int:
        """Bytes from row to row; 0 for what is compressed."""
        width = ROW_BYTES.get(self.pixels, 0) * self.width
        return width + self.padding if width else 0

    @property
    def sizes(self) -> tuple[int, ...]:
        """Sizes of the pieces of memory that hold any picture of this format."""
        brightness, colours = self.stride * self.height, self.stride * self.height // 2
        if self.pixels == "NM12":
            return brightness, colours
        if self.pixels == "NV12":
            return (brightness + colours,)
        return (brightness or self.width * self.height * 3,)


def encode(
    image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    form: PixelFormat,
    number: int,
    corrupt: bool,
) -> tuple[list[npt.NDArray[np.uint8]], bool]:
    """The bytes of each piece, and whether the kernel would have noticed the damage."""
    if form.pixels in ("MJPG", "H264"):
        # It is cut where a USB packet got lost; the kernel does not look into it.
        whole = _jpeg(image) if form.pixels == "MJPG" else _h264(image, number)
        return [whole[2:] if corrupt else whole], False
    rows = np.concatenate([_pad(each, form) for each in _planes(image, form)])
    parts = [rows] if len(form.sizes) == 1 else [rows[: form.height], rows[form.height :]]
    return [part.reshape(-1) for part in parts], corrupt


def _jpeg(
    image: Bytes,  # [H, W, 3] RGB
) -> Bytes:
    import cv2

    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), quality)
    return np.asarray(jpeg, np.uint8).reshape(-1)


def _h264(
    image: Bytes,  # [H, W, 3] RGB
    number: int,
) -> Bytes:
    return np.frombuffer(access_unit(image, number), np.uint8)


def _planes(
    image: Bytes,  # [H, W, 3] RGB
    form: PixelFormat,
) -> list[Bytes]:
    """Rows of bytes, one after the other in memory."""
    import cv2

    height, width = image.shape[:2]
    if form.pixels == "GREY":
        return [np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)]
    if form.pixels in HALF_COLOURED:
        planar = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420), np.uint8)
        halves = planar[height:].reshape(2, -1)
        return [planar[:height], np.stack(list(halves), -1).reshape(height // 2, width)]
    code = cv2.COLOR_RGB2YUV_YUYV if form.pixels == "YUYV" else cv2.COLOR_RGB2YUV_UYVY
    return [np.asarray(cv2.cvtColor(image, code), np.uint8).reshape(height, -1)]


def _pad(
    plane: Bytes,  # [rows, bytes]
    form: PixelFormat,
) -> Bytes:
    rows = np.zeros((len(plane), form.stride), np.uint8)
    rows[:, : plane.shape[1]] = plane
    return rows
