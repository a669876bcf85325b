"""What a finished dive keeps of its keyframes, to recognise a place another day: ``places.npz``.

Descriptors are kept in four bits for each number. They are only ever compared after the square
root of each number's share in the whole was taken (RootSIFT), and it is that root which is rounded.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError, InputError, reason_of
from aquaflow.base.storage.archive import UNREADABLE, open_archive, read_array
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.geometry.camera import CameraModel, at_pixels
from aquaflow.geometry.similarity import Sim3
from aquaflow.prior.contract import Float, Keypoints

Array = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]

LEVELS = 15
"""Largest code of a descriptor's number: half a byte."""
LARGEST_ROOT = 0.375
"""Root of a number's share that gets the largest code; beyond it is cut off. SIFT cuts its numbers
at 0.2 of the length (D. Lowe, IJCV 2004); of a frame each of the reef and Curasao clips none is
beyond. The rounding moves a descriptor of length 1 by 0.075 there (median, measured)."""
PIXEL_STEPS = 1 << 16
"""Steps of a coordinate over the side of the picture: 0.007 px at 480 px."""
LARGEST_HALF = 6e4
"""Near the largest number that float16 holds."""


@dataclass(frozen=True)
class KeypointDepths:
    """Keypoints of a picture, and what is known of how far away their points are."""

    camera: CameraModel
    keypoints: Keypoints
    rho: Array
    """[M] 1 / z in the unit of the keyframe; 0 where unknown."""
    variance: Array
    """[M] variance of ``rho``."""

    def is_known(
        self,
        relative_sigma: float,
    ) -> npt.NDArray[np.bool_]:
        """[M] keypoints whose inverse depth is known to better than ``relative_sigma``."""
        return (self.rho > 1e-6) & (self.variance < (relative_sigma * self.rho) ** 2)

    def points(self) -> Array:
        """[M, 3] in the camera's frame, in the unit of the keyframe; NaN where unknown."""
        rays = self.camera.unproject(self.keypoints.pixels.astype(np.float64))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.rho[:, None] > 1e-6, rays / self.rho[:, None], np.nan)


def depths_at(keypoints: Keypoints, pointmap: Pointmap) -> KeypointDepths:
    """What the ``pointmap`` of their picture knows of the keypoints' depths."""
    pixels = keypoints.pixels
    rho, variance = at_pixels(pointmap.rho, pixels), at_pixels(pointmap.variance, pixels)
    return KeypointDepths(pointmap.camera, keypoints, rho, variance)


@dataclass(frozen=True)
class KeyframePlace:
    """A keyframe of a finished dive without its picture."""

    number: int
    """Among the dive's keyframes."""
    frame_index: int
    sub_map: int
    t_ns: int
    T_mc: Sim3
    """Camera to m, the world of the sub-map's ``map.aqf``; its scale takes the keyframe's unit to
    that of m."""
    camera: CameraModel


def pack(seen: KeypointDepths) -> npt.NDArray[np.void]:
    """[] one structured number: pixels, inverse depths, their sigmas, descriptors."""
    count, dimension = seen.keypoints.descriptors.shape
    if dimension % 2:
        raise ValueError("a descriptor with an odd number of dimensions is not kept")
    row = np.zeros((), features_dtype(count, dimension))
    side = (seen.camera.width, seen.camera.height)
    steps = np.floor(seen.keypoints.pixels / side * PIXEL_STEPS)
    row["pixels"] = np.clip(steps, 0, PIXEL_STEPS - 1)
    known = (seen.rho > 1e-6) & (seen.variance < UNKNOWN_VARIANCE)
    row["rho"] = np.where(known, seen.rho, 0.0)
    sigma = np.sqrt(np.maximum(seen.variance, 0.0)) / np.where(known, seen.rho, 1.0)
    row["sigma"] = np.where(known, np.minimum(sigma, LARGEST_HALF), 0.0)
    row["descriptors"] = _codes(seen.keypoints.descriptors)
    return row


def unpack(
    row: npt.NDArray[np.void],  # [] as from packed
    camera: CameraModel,
) -> KeypointDepths:
    """What :func:`pack` took apart, rounded.

    Raises:
        DamagedError: it holds numbers that it cannot hold.
    """
    names = ("pixels", "rho", "sigma", "descriptors")
    if row.shape != () or row.dtype.names != names:
        raise DamagedError("it is not what a keyframe keeps")
    count, half = row["descriptors"].shape
    if row.dtype != features_dtype(count, 2 * half):
        raise DamagedError("it is not what a keyframe keeps")
    rho, sigma = row["rho"].astype(np.float64), row["sigma"].astype(np.float64)
    if not (np.isfinite(rho).all() and np.isfinite(sigma).all()):
        raise DamagedError("a depth is not finite")
    if (rho < 0.0).any() or (sigma < 0.0).any():
        raise DamagedError("a depth is negative")
    pixels = (row["pixels"] + 0.5) / PIXEL_STEPS * (camera.width, camera.height)
    variance = np.where(rho > 0.0, (sigma * rho) ** 2, UNKNOWN_VARIANCE)
    keypoints = Keypoints(pixels.astype(np.float32), _descriptors(row["descriptors"]))
    return KeypointDepths(camera, keypoints, rho, variance)


def features_dtype(count: int, dimension: int) -> np.dtype[np.void]:
    """Data type of ``count`` keypoints whose descriptors have ``dimension`` numbers, each kind
    together."""
    return np.dtype(
        [
            ("pixels", "<u2", (count, 2)),
            ("rho", "<f4", (count,)),
            ("sigma", "<f2", (count,)),
            ("descriptors", "u1", (count, dimension // 2)),
        ]
    )


def _codes(
    descriptors: Float,  # [M, d] not negative
) -> Bytes:
    """[M, d / 2]"""
    if (descriptors < 0.0).any():
        raise ValueError("a descriptor with negative numbers is not kept")
    share = descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-12)
    codes = np.rint(np.sqrt(share) * (LEVELS / LARGEST_ROOT))
    codes = np.minimum(codes, LEVELS).astype(np.uint8)
    return np.asarray((codes[:, ::2] << 4) | codes[:, 1::2], dtype=np.uint8)


def _descriptors(
    codes: Bytes,  # [M, d / 2]
) -> Float:
    """[M, d] shares, of which only the ratios count."""
    count, half = codes.shape
    both = np.stack([codes >> 4, codes & LEVELS], axis=-1).reshape(count, 2 * half)
    return np.asarray((both * np.float32(LARGEST_ROOT / LEVELS)) ** 2, dtype=np.float32)


# --------------------------------------------------------------------------------------------------
# Inverse depths of a keyframe's pixels: triangulated, and what a prior knows of them.

Mask = npt.NDArray[np.bool_]

UNKNOWN_VARIANCE = 1e6
"""Variance of an inverse depth that nothing has been measured about."""


@dataclass(frozen=True)
class LearnedDepths:
    """What a prior knows of a keyframe's depths without parallax, in the keyframe's unit."""

    rho: Array
    """[H, W] 1 / z; 0 where unknown."""
    variance: Array
    """[H, W] variance of ``rho``."""
    log_scale: float
    """Logarithm of the keyframe's unit over the prior's."""
    log_scale_sigma: float


@dataclass
class Pointmap:
    """Inverse depth of every pixel with its variance, in the camera frame (paper: X_k^k with Q)."""

    camera: CameraModel
    rho: Array
    """[H, W] 1 / z, triangulated; 0 where unknown."""
    variance: Array
    """[H, W] variance of ``rho``."""
    fused: int = 0
    """Frames whose depths were fused into it."""
    learned: LearnedDepths | None = None

    @staticmethod
    def unknown(camera: CameraModel) -> Pointmap:
        """One that knows nothing of any pixel."""
        shape = (camera.height, camera.width)
        return Pointmap(camera, np.zeros(shape), np.full(shape, UNKNOWN_VARIANCE))

    def is_known(
        self,
        relative_sigma: float,
    ) -> Mask:
        """[H, W] pixels whose inverse depth is known to better than ``relative_sigma``."""
        return (self.rho > 1e-6) & (self.variance < (relative_sigma * self.rho) ** 2)

    def complete(
        self,
        relative_sigma: float,
    ) -> Pointmap:
        """Itself, or a copy with the learned depths wherever it does not know its own to
        ``relative_sigma``."""
        learned = self.learned
        if learned is None:
            return self
        instead = (learned.rho > 0.0) & ~self.is_known(relative_sigma)
        rho = np.where(instead, learned.rho, self.rho)
        variance = np.where(instead, learned.variance, self.variance)
        return replace(self, rho=rho, variance=variance, learned=None)

    def not_learned(
        self,
        pixels: Mask,  # [H, W]
    ) -> Pointmap:
        """The same, but of ``pixels`` nothing is learned."""
        if self.learned is None:
            return self
        rho = np.where(pixels, 0.0, self.learned.rho)
        return replace(self, learned=replace(self.learned, rho=rho))

    @property
    def Q(self) -> Array:
        """[H, W] point confidence: 1 / relative variance; 0 where unknown."""
        known = (self.rho > 1e-6) & (self.variance < UNKNOWN_VARIANCE)
        return np.where(known, self.rho**2 / np.maximum(self.variance, 1e-12), 0.0)

    def points(self) -> Array:
        """[H, W, 3] pointmap in the camera frame; NaN where unknown."""
        rays = self.camera.unproject(self.camera.pixel_centres())
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.rho[..., None] > 1e-6, rays / self.rho[..., None], np.nan)

    def copy(self) -> Pointmap:
        """A copy with arrays of its own; learned depths are never changed in place."""
        return replace(self, rho=self.rho.copy(), variance=self.variance.copy())


# --------------------------------------------------------------------------------------------------
# ``places.npz``: the keyframes of a finished dive, to recognise its places another day.
#
# One array for each keyframe, so that neither who writes nor who reads holds more than one of them.

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
        """The keypoints of a keyframe, read from the file at each call.

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
