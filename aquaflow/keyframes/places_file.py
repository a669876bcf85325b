"""``places.npz``: the keyframes of a finished dive, to recognise its places another day.

One array for each keyframe, so that neither who writes nor who reads holds more than one of them.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Iterable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError, InputError, reason_of
from aquaflow.base.storage.archive import UNREADABLE, open_archive, read_array
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes.place import KeyframePlace, KeypointDepths, pack, unpack

Rows = npt.NDArray[Any]
"""A structured array."""

NAME = "places.npz"
"""In a dive's folder (docs/formats.md#places)."""
FORMAT = 1
"""Raised whenever an older AquaFlow could no longer read the file."""
ABOUT, INDEX, EDGES = "about", "index", "edges"
"""Arrays beside those of the keyframes."""
EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time of every array in the file: the same dive gives the same bytes."""
EFFORT = 1
"""Of the compression, of 9: 6 takes twice the time, for 1 % of the size (measured)."""
ROTATION_TOLERANCE = 1e-6
"""Largest difference of R^T R from the identity: rounding is far below."""

_SIM3 = [("R", "<f8", (3, 3)), ("t", "<f8", (3,)), ("scale", "<f8")]
PLACE = np.dtype(
    [
        *[(name, "<i8") for name in ("number", "frame", "sub_map", "t_ns", "width", "height")],
        *[(name, "<f8") for name in ("fx", "fy", "cx", "cy")],
        *_SIM3,
    ]
)
"""A keyframe: its numbers, camera and T_mc."""
EDGE = np.dtype(
    [
        ("a", "<i8"),
        ("b", "<i8"),
        *_SIM3,
        ("information", "<f8", (7, 7)),
        ("trust", "<f8"),
        ("loop", "?"),
    ]
)
"""A measured relative pose T_ab of two keyframes, given by number; ``information`` is of its right
tangent, T_ab exp(d), ``trust`` 0 to 1, 0 for a loop that the other edges contradict."""
MOST_BYTES = 1 << 27
"""Of one array: a keyframe's keypoints take 0.1 to 2 MB, 100,000 edges 54 MB."""
MOST_ABOUT_BYTES = 1 << 16
"""The format and a number."""
HEADER_BYTES = 1 << 14
"""More than NumPy allows before the numbers of an array."""


def write_places(
    path: Path,
    places: Iterable[tuple[KeyframePlace, KeypointDepths]],
    edges: Rows,  # [E] EDGE
) -> int:
    """Write the keyframes as they come, and the edges between them; how many there were.

    Raises:
        InputError: the file cannot be written.
    """
    rows = []
    with atomic_write(path) as stream, zipfile.ZipFile(stream, "w") as archive:
        for place, seen in places:
            _add(archive, _name(place.number), pack(seen))
            rows.append(_row(place))
        index = np.array(rows, PLACE) if rows else np.zeros(0, PLACE)
        there = np.isin(edges["a"], index["number"]) & np.isin(edges["b"], index["number"])
        _add(archive, INDEX, index)
        _add(archive, EDGES, edges[there])
        about = json.dumps({"format": FORMAT, "keyframes": len(rows)}).encode()
        _add(archive, ABOUT, np.frombuffer(about, np.uint8))
    return len(rows)


class PlacesFile:
    """The keyframes of a finished dive: index and graph in memory, keypoints when asked for."""

    def __init__(self, path: Path) -> None:
        """Read index and graph.

        Raises:
            InputError: the file is missing, damaged, or of a newer AquaFlow.
        """
        self.path = path
        about = self._guard(lambda: json.loads(self._array(ABOUT).tobytes()))
        if not isinstance(about, dict) or about.get("format") != FORMAT:
            raise InputError(
                f"{path} is not in format {FORMAT}, which this AquaFlow reads; update AquaFlow, or "
                "map the dive again"
            )
        self.places: tuple[KeyframePlace, ...] = self._guard(self._index)
        """In the order of their numbers."""
        self.edges: Rows = self._guard(self._edges)
        """[E] EDGE: the keyframe graph."""

    @cached_property
    def by_number(self) -> dict[int, KeyframePlace]:
        """The keyframes by their numbers."""
        return {place.number: place for place in self.places}

    def keypoints(self, number: int) -> KeypointDepths:
        """Of a keyframe, read from the file at each call.

        Raises:
            InputError: it is damaged.
        """
        camera = self.by_number[number].camera
        found: KeypointDepths = self._guard(lambda: unpack(self._array(_name(number)), camera))
        return found

    def _guard(self, read: Callable[[], Any]) -> Any:
        try:
            return read()
        except FileNotFoundError as error:
            raise InputError(
                f"{self.path} is missing: the dive was mapped by an older AquaFlow, or has no "
                "keyframe; map it again"
            ) from error
        except UNREADABLE as error:
            what = reason_of(error) if isinstance(error, (OSError, DamagedError)) else "damaged"
            raise InputError(f"cannot read {self.path}: {what}; map the dive again") from error

    def _array(self, name: str) -> Rows:
        with open_archive(self.path) as archive:
            limit = MOST_ABOUT_BYTES if name == ABOUT else MOST_BYTES
            if name == INDEX:
                limit = HEADER_BYTES + PLACE.itemsize * len(archive.namelist())
            return read_array(archive, name, limit)

    def _index(self) -> tuple[KeyframePlace, ...]:
        rows = self._array(INDEX)
        if rows.dtype != PLACE or rows.ndim != 1:
            raise DamagedError("its index is none")
        _check_similarities(rows)
        intrinsics = np.stack([rows[name] for name in ("fx", "fy", "cx", "cy")])
        if not np.isfinite(intrinsics).all() or (intrinsics[:2] <= 0.0).any():
            raise DamagedError("a camera is none")
        if (rows["width"] < 1).any() or (rows["height"] < 1).any():
            raise DamagedError("a camera is none")
        if (np.diff(rows["number"]) <= 0).any():
            raise DamagedError("its keyframes are in no order")
        return tuple(_place(row) for row in rows)

    def _edges(self) -> Rows:
        rows = self._array(EDGES)
        if rows.dtype != EDGE or rows.ndim != 1:
            raise DamagedError("its graph is none")
        _check_similarities(rows)
        if not (np.isfinite(rows["information"]).all() and np.isfinite(rows["trust"]).all()):
            raise DamagedError("an edge is not finite")
        if not np.isin([rows["a"], rows["b"]], list(self.by_number)).all():
            raise DamagedError("an edge joins keyframes that are not there")
        return rows


def _check_similarities(
    rows: Rows,  # [N] with R, t and scale
) -> None:
    R, t, scale = rows["R"], rows["t"], rows["scale"]
    if not all(np.isfinite(part).all() for part in (R, t, scale)) or (scale <= 0.0).any():
        raise DamagedError("a pose is not finite")
    apart = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3))
    if apart.max(initial=0.0) > ROTATION_TOLERANCE or (np.linalg.det(R) < 0.0).any():
        raise DamagedError("a pose's rotation is none")


def _name(number: int) -> str:
    return f"keyframe_{number:06d}"


def _add(
    archive: zipfile.ZipFile,
    name: str,
    array: Rows,  # [...]
) -> None:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, allow_pickle=False)
    entry = zipfile.ZipInfo(f"{name}.npy", EPOCH)
    archive.writestr(entry, stream.getvalue(), zipfile.ZIP_DEFLATED, EFFORT)


def _row(place: KeyframePlace) -> tuple[Any, ...]:
    camera, T = place.camera, place.T_mc
    return (
        *(place.number, place.frame_index, place.sub_map, place.t_ns),
        *(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy),
        *(T.R, T.t, T.scale),
    )


def _place(row: Any) -> KeyframePlace:  # one of PLACE
    width, height = int(row["width"]), int(row["height"])
    fx, fy, cx, cy = (float(row[name]) for name in ("fx", "fy", "cx", "cy"))
    T_mc = Sim3(np.array(row["R"]), np.array(row["t"]), float(row["scale"]))
    return KeyframePlace(
        int(row["number"]), int(row["frame"]), int(row["sub_map"]), int(row["t_ns"]), T_mc,
        CameraModel(width, height, fx, fy, cx, cy),
    )  # fmt: skip
