"""Gaussian maps as standard 3DGS PLY files, which every splat viewer opens.

Layout: B. Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", reference
code, ``save_ply``: binary little-endian float32; opacity as logit, scales as logarithm, rotation
wxyz, colour as the zeroth spherical harmonic.
"""

from __future__ import annotations

import os
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import open_regular
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.geometry.similarity import Sim3

Array = npt.NDArray[np.floating]

SH_C0 = 0.28209479177387814
"""The zeroth spherical harmonic, 1 / (2 sqrt(pi))."""

PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
"""Columns of a 3DGS file without higher harmonics, in the order that viewers expect."""

OPACITY_MARGIN = 1e-6
"""Opacities are kept this far from 0 and 1, where the logit is infinite."""

CHUNK = 1 << 18
"""Gaussians that are encoded at a time: 60 MB."""

HEADER_LIMIT = 64 * 1024
"""Bytes within which a header must end; the 3DGS header with all harmonics has 1.5 kB."""

PLY_TYPES = {
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
}
"""Names of PLY number types and the numpy types that they are."""


Which: TypeAlias = slice | npt.NDArray[np.bool_] | npt.NDArray[np.integer[Any]]
"""Some of N Gaussians: [N] True for those, or [M] their numbers."""


@dataclass(frozen=True)
class PlyGaussians:
    """The Gaussians of a PLY file, in natural units (no logits, no logarithms)."""

    means: Array
    """[N, 3] world."""
    wxyz: Array
    """[N, 4] rotations."""
    scales: Array
    """[N, 3] standard deviations along the axes, world unit, > 0."""
    opacities: Array
    """[N] in [0, 1]."""
    colours: Array
    """[N, 3] RGB, usually in [0, 1]."""

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    def rows(
        self,
        which: Which,  # [M] numbers, or [N] bool
    ) -> PlyGaussians:
        """Some of the Gaussians."""
        return PlyGaussians(
            self.means[which], self.wxyz[which], self.scales[which], self.opacities[which],
            self.colours[which],
        )  # fmt: skip

    def transform(self, T: Sim3) -> PlyGaussians:
        """The same Gaussians in the frame that ``T`` maps to; their covariance C becomes
        s^2 R C R^T. Colours stay: they are the same from every direction (degree 0)."""
        w, v = T.quaternion[0], T.quaternion[1:]
        w_each, v_each = self.wxyz[:, :1], self.wxyz[:, 1:]
        turned = np.hstack(
            [w * w_each - v_each @ v[:, None], w * v_each + w_each * v + np.cross(v, v_each)]
        )  # the product of the quaternions: SciPy's refuses zeros, which a file may hold
        return replace(
            self,
            means=T.apply(self.means.astype(np.float64)),
            wxyz=turned,
            scales=T.scale * self.scales,
        )


def write_ply(path: Path, splats: PlyGaussians) -> int:
    """Write a PLY file atomically; returns how many Gaussians were left out as not finite.

    Raises:
        InputError: the file cannot be written.
    """
    parts = []
    for first in range(0, len(splats), CHUNK):
        table = _encode(splats.rows(slice(first, first + CHUNK)))
        finite = np.isfinite(table).all(axis=1)
        parts.append(np.ascontiguousarray(table[finite], dtype="<f4"))
    count = sum(map(len, parts))
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in PROPERTIES]
    with atomic_write(path) as stream:
        stream.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        for rows in parts:
            stream.write(rows.data)
    return len(splats) - count


def _encode(splats: PlyGaussians) -> npt.NDArray[np.float32]:
    """The PLY's columns [N, 17]; what has no finite value stays not finite."""
    opacity = np.clip(
        splats.opacities.astype(np.float64), OPACITY_MARGIN, 1.0 - OPACITY_MARGIN
    )  # NaN passes through
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        columns = [
            splats.means,
            np.zeros_like(splats.means),
            (splats.colours.astype(np.float64) - 0.5) / SH_C0,
            np.log(opacity / (1.0 - opacity))[:, None],
            np.log(splats.scales.astype(np.float64)),
            splats.wxyz / np.linalg.norm(splats.wxyz, axis=1, keepdims=True),
        ]
        return np.concatenate(columns, axis=1).astype(np.float32)


class PlyFile:
    """The Gaussians of a 3DGS PLY, of which memory holds what was asked for; harmonics above the
    zeroth are ignored."""

    def __init__(self, path: Path) -> None:
        """
        Raises:
            InputError: the file is not a binary 3DGS PLY or is cut off.
        """
        self._T: Sim3 | None = None
        try:
            with open_regular(path) as stream:
                count, dtype = _read_header(stream, path)
                start = stream.tell()
                there = (os.fstat(stream.fileno()).st_size - start) // max(dtype.itemsize, 1)
                if there < count:
                    raise InputError(
                        f"{path} is cut off: {there} of {count} Gaussians are there; copy or "
                        "export it again"
                    )
                self._table: npt.NDArray[np.void] = np.zeros(0, dtype)
                if count:
                    self._table = np.memmap(stream, dtype, "r", start, (count,))
        except OSError as error:
            raise InputError(
                f"cannot read the map {path}: {error.strerror}; give a PLY file"
            ) from error

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self._table)

    def transform(self, T: Sim3) -> PlyFile:
        """The same Gaussians in the frame that ``T`` maps to."""
        moved = copy(self)
        moved._T = T if self._T is None else T @ self._T
        return moved

    def rows(
        self,
        which: Which,  # [M] numbers, or [N] bool
    ) -> PlyGaussians:
        """Some of the Gaussians."""
        table = self._table[which]

        def columns(*names: str) -> npt.NDArray[np.float32]:
            return np.stack([table[name].astype(np.float32) for name in names], axis=-1)

        logit = columns("opacity")[:, 0].astype(np.float64)
        found = PlyGaussians(
            means=columns("x", "y", "z"),
            wxyz=columns("rot_0", "rot_1", "rot_2", "rot_3"),
            scales=np.exp(columns("scale_0", "scale_1", "scale_2")),
            opacities=(0.5 * (1.0 + np.tanh(0.5 * logit))).astype(np.float32),
            colours=columns("f_dc_0", "f_dc_1", "f_dc_2") * np.float32(SH_C0) + np.float32(0.5),
        )
        return found if self._T is None else found.transform(self._T)


def read_ply(path: Path) -> PlyGaussians:
    """All Gaussians of a :class:`PlyFile`.

    Raises:
        InputError: the file is not a binary 3DGS PLY or is cut off.
    """
    return PlyFile(path).rows(slice(None))


def _read_header(stream: BinaryIO, path: Path) -> tuple[int, np.dtype[np.void]]:
    """Number of Gaussians and the layout of one; leaves the stream at the first of them."""
    lines = _header_lines(stream, path)
    if "format binary_little_endian 1.0" not in lines:
        raise InputError(f"{path} is not a binary little-endian PLY; save it in that format")
    count: int | None = None
    fields: list[tuple[str, str]] = []
    for line in lines:
        words = line.split()
        if words[:1] == ["element"]:
            if words[1:2] != ["vertex"] or count is not None:
                break  # elements after the vertices are not read
            count = int(words[2]) if words[2:] and words[2].isdecimal() else 0
        elif words[:1] == ["property"]:
            if len(words) != 3 or words[1] not in PLY_TYPES:
                raise InputError(f"{path} has a property that no Gaussian map has")
            fields.append((words[2], PLY_TYPES[words[1]]))
    needed = set(PROPERTIES) - {"nx", "ny", "nz"}
    missing = sorted(needed - {name for name, _ in fields})
    if count is None or missing:
        raise InputError(
            f"{path} holds no Gaussians: it lacks {', '.join(missing) or 'vertices'}; give a PLY "
            "that a Gaussian-splatting program wrote"
        )
    return count, np.dtype(fields)


def _header_lines(stream: BinaryIO, path: Path) -> list[str]:
    """The header's lines without the last."""
    lines: list[str] = []
    size = 0
    while size < HEADER_LIMIT:
        raw = stream.readline(HEADER_LIMIT)
        size += len(raw)
        line = raw.decode("ascii", errors="replace").strip()
        if not raw or (not lines and line != "ply"):
            break
        if line == "end_header":
            return lines
        lines.append(line)
    raise InputError(f"{path} is not a PLY file; give a map that 'aquaflow map' wrote")
