"""H.264 without an encoder: pictures of macroblocks that hold their samples as they are (I_PCM).

Every picture is a key frame of the baseline profile with its parameters before it, as simulated
cameras send them (ITU-T H.264, 7.3). Nothing is compressed, so the pictures have to be small.
"""

from __future__ import annotations

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
