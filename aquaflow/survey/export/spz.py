"""Compressed maps as SPZ files, for viewers in a browser.

Format: Niantic Labs, github.com/nianticlabs/spz, "File Format", version 3, with what its reference
code (MIT) adds on quantisation; no code of it is used. A gzip stream of a header and then, for all
Gaussians each, positions, opacities, colours, scales and rotations. Its axes are right, up, back.
"""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.storage.atomic import atomic_write
from aquaflow.dive.dive import Dive
from aquaflow.dive.placement import Placement, placement
from aquaflow.dive.ply import SH_C0, PlyFile, PlyGaussians
from aquaflow.dive.point_cloud import CHUNK, read_splats
from aquaflow.geometry.similarity import Sim3

Array = npt.NDArray[np.floating]
Bytes = npt.NDArray[np.uint8]
Encode = Callable[[PlyGaussians], Bytes]

MAGIC, VERSION = 0x5053474E, 3
RIGHT_UP_BACK = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""From right, forward, up."""
MOST_FRACTION_BITS = 12
"""Of a coordinate, as the reference code has it: 0.24 of a thousandth of the unit. Fewer where a
Gaussian lies further than 2048 units from the origin."""
LARGEST_COORDINATE = 2**23 - 1
"""Of 24 bits with a sign."""
COLOUR_SCALE = 0.15
"""Of the zeroth harmonic: bytes reach from -0.44 to 1.44 of the colour."""
LEAST_LOG_SCALE, LOG_SCALE_STEPS = -10.0, 16.0
"""The logarithm of a scale that byte 0 stands for, and bytes for each e-fold."""
ROTATION_BITS = 9
"""Of each of the three smallest components of a quaternion, besides its sign."""


def export_spz(dive: Dive, path: Path, water: bool = False) -> tuple[int, Placement]:
    """Write the dive's largest sub-map, without water or with it; returns the number of Gaussians
    and where they lie, which is upright with y up.

    Raises:
        InputError: the dive has no map, or the file cannot be written.
    """
    where = replace(placement(dive.frame), grid=None)  # whose numbers are too large
    turned = replace(where, T_un=Sim3(RIGHT_UP_BACK, np.zeros(3), 1.0) @ where.T_un)
    splats = read_splats(dive, turned, water)
    write_spz(path, splats)
    return len(splats), where


def write_spz(path: Path, splats: PlyGaussians | PlyFile) -> None:
    """Write Gaussians, whose axes are right, up, back.

    Raises:
        InputError: the file cannot be written.
    """
    count = len(splats)
    parts = [slice(first, first + CHUNK) for first in range(0, count, CHUNK)]
    reach = max((_reach(splats.rows(part).means) for part in parts), default=0.0)
    bits = fraction_bits(reach)
    encoders: tuple[Encode, ...] = (
        lambda part: _positions(part.means, bits),
        lambda part: _bytes(255.0 * part.opacities),
        lambda part: _bytes(
            255.0 * (0.5 + COLOUR_SCALE * (part.colours.astype(np.float64) - 0.5) / SH_C0)
        ),
        lambda part: _bytes(LOG_SCALE_STEPS * (np.log(part.scales) - LEAST_LOG_SCALE)),
        lambda part: smallest_three(part.wxyz),
    )
    with (
        atomic_write(path) as stream,
        gzip.GzipFile(filename="", mode="wb", fileobj=stream, mtime=0) as packed,
    ):
        # Degree 0 of the harmonics, no flags, a reserved byte.
        packed.write(struct.pack("<3I4B", MAGIC, VERSION, count, 0, bits, 0, 0))
        for encode in encoders:
            for part in parts:
                packed.write(encode(splats.rows(part)).tobytes())


def _reach(
    means: Array,  # [N, 3]
) -> float:
    """The largest coordinate, without its sign."""
    return float(np.abs(means).max(initial=0.0))


def fraction_bits(reach: float) -> int:
    """Bits behind the point with which every coordinate up to ``reach`` fits into 24."""
    return max(0, min(MOST_FRACTION_BITS, int(np.log2(LARGEST_COORDINATE / max(reach, 1.0)))))


def _positions(
    means: Array,  # [N, 3]
    bits: int,
) -> Bytes:
    """[N, 3, 3] little-endian fixed-point numbers of 24 bits."""
    fixed = np.round(means.astype(np.float64) * 2.0**bits)
    fixed = np.clip(fixed, -LARGEST_COORDINATE, LARGEST_COORDINATE).astype("<i4")
    return np.ascontiguousarray(fixed).view(np.uint8).reshape(-1, 3, 4)[..., :3]


def _bytes(
    values: Array,  # [...]
) -> Bytes:
    return np.asarray(np.clip(np.round(values), 0.0, 255.0)).astype(np.uint8)


def smallest_three(
    wxyz: Array,  # [N, 4] rotations
) -> Bytes:
    """[N, 4] bytes: which of x, y, z, w is the largest (2 bits), and sign and size of the others in
    their order (size in 511ths of 1 / sqrt 2, which none exceeds)."""
    xyzw = wxyz[:, [1, 2, 3, 0]].astype(np.float64)
    xyzw /= np.maximum(np.linalg.norm(xyzw, axis=1, keepdims=True), np.finfo(float).tiny)
    largest = np.argmax(np.abs(xyzw), axis=1)
    sign = np.where(np.take_along_axis(xyzw, largest[:, None], axis=1) < 0.0, -1.0, 1.0)
    is_other = np.arange(4) != largest[:, None]
    others = (xyzw * sign)[is_other].reshape(-1, 3)
    most = 2**ROTATION_BITS - 1
    sizes = np.minimum(np.round(most * np.sqrt(2.0) * np.abs(others)), most).astype(np.uint32)
    packed = largest.astype(np.uint32)
    for size, is_negative in zip(sizes.T, (others < 0.0).T, strict=True):
        packed = packed << (ROTATION_BITS + 1) | is_negative.astype(np.uint32) << ROTATION_BITS
        packed |= size
    return np.asarray(packed.astype("<u4").view(np.uint8).reshape(-1, 4))
