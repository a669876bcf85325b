"""Simulated dives with true depth and poses: TartanAir (Wang et al., IROS 2020) and MIMIR-UW.

TartanAir, version 1: ``ocean/Easy/P000/{image_left/000000_left.png,
depth_left/000000_left_depth.npy, pose_left.txt}``, 640 x 480.
Version 2: ``Ocean/Data_easy/P000/{image_lcam_front/
000000_lcam_front.png, depth_lcam_front/000000_lcam_front_depth.png, pose_lcam_front.txt}``,
640 x 640, depth as the four bytes of a float32. A field of view of 90 degrees in both; poses are
``tx ty tz qx qy qz qw``, camera axes x forward, y right, z down.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError, InputError, reason_of
from aquaflow.base.errors.regular_file import read_mapping
from aquaflow.lab.training.datasets.posed import (
    NED_TO_OPTICAL,
    Array,
    Depth,
    Frames,
    Posed,
    nothing_in,
    pinhole,
    pose,
    read_image,
    table,
)

SIDES = ("left", "lcam_front")
"""Camera of version 1 and of version 2."""


def tartanair(root: Path) -> list[Frames]:
    """Every trajectory under ``root``.

    Raises:
        InputError: there is none, or one has not a pose for every picture.
    """
    found = [
        _trajectory(path.parent, side, root)
        for side in SIDES
        for path in sorted(root.rglob(f"pose_{side}.txt"))
    ]
    if not found:
        raise nothing_in(root, "TartanAir trajectory (pose_left.txt or pose_lcam_front.txt)")
    return found


def _trajectory(folder: Path, side: str, root: Path) -> Frames:
    poses = table(folder / f"pose_{side}.txt", 7)
    images = sorted((folder / f"image_{side}").glob(f"*_{side}.png"))
    if len(images) != len(poses):
        raise InputError(
            f"{folder} has {len(images)} pictures and {len(poses)} poses; unpack it again"
        )
    readers = []
    for image, row in zip(images, poses, strict=True):
        T_wc = pose(row[:3], np.roll(row[3:], 1)) @ NED_TO_OPTICAL
        stem = folder / f"depth_{side}" / f"{image.stem}_depth"
        readers.append(partial(_frame, image, stem, T_wc))
    return Frames(str(folder.relative_to(root)), tuple(readers))


def _frame(
    image: Path,
    depth_stem: Path,
    T_wc: Array,  # [4, 4] m
) -> Posed:
    picture = read_image(image)
    height, width = picture.shape[:2]
    K = pinhole(width / 2, width / 2, width / 2, height / 2)
    return Posed(picture, _depth(depth_stem), K, T_wc)


def _depth(stem: Path) -> Depth:
    npy, png = stem.with_name(stem.name + ".npy"), stem.with_name(stem.name + ".png")
    if npy.is_file():
        return np.asarray(np.load(npy), dtype=np.float32)
    packed = cv2.imread(str(png), cv2.IMREAD_UNCHANGED) if png.is_file() else None
    if packed is None or packed.shape[-1] != 4:
        raise InputError(f"cannot read the depth of {stem}; unpack the data set again")
    return np.asarray(np.ascontiguousarray(packed).view("<f4")[..., 0], dtype=np.float32)


# --------------------------------------------------------------------------------------------------
# Depth from OpenEXR files, as simulators write them: one part, scan lines, float or half numbers.
#
# OpenCV's wheels are built without OpenEXR; of its format (openexr.com, "File Layout") this reads
# what AirSim writes: no compression, or zip of one or of sixteen lines.

MAGIC = 20000630
"""The first four bytes of an OpenEXR file."""
LINES = {0: 1, 2: 1, 3: 16}
"""Lines of a block by compression: none, zip of one line, zip."""
DTYPES: dict[int, np.dtype[Any]] = {1: np.dtype("<f2"), 2: np.dtype("<f4")}
"""Pixel types half and float."""


@dataclass(frozen=True)
class _Header:
    channels: list[tuple[str, np.dtype[Any]]]
    """In the order of the file."""
    compression: int
    height: int
    width: int
    first_line: int


def read_exr(path: Path) -> npt.NDArray[np.float32]:
    """[H, W] the first channel.

    Raises:
        InputError: the file is damaged, or of a kind that is not read here.
    """
    try:
        data = path.read_bytes()
        if struct.unpack_from("<I", data)[0] != MAGIC:
            raise DamagedError("it is no OpenEXR file")
        header, at = _header(data)
        return _pixels(data, header, at)
    except (OSError, ValueError, LookupError, struct.error, zlib.error) as error:
        said = reason_of(error)
        raise InputError(f"cannot read {path} ({said}); convert it to 32-bit zip") from error


def _header(data: bytes) -> tuple[_Header, int]:
    """The header, and where the blocks' offsets begin."""
    at, found = 8, {}
    while data[at] != 0:
        name, at = _string(data, at)
        _, at = _string(data, at)
        size = struct.unpack_from("<i", data, at)[0]
        found[name] = data[at + 4 : at + 4 + size]
        at += 4 + size
    x0, y0, x1, y1 = struct.unpack("<4i", found["dataWindow"])
    header = _Header(
        _channels(found["channels"]), found["compression"][0], y1 - y0 + 1, x1 - x0 + 1, y0
    )
    if header.compression not in LINES:
        raise DamagedError(f"its compression is number {header.compression}")
    return header, at + 1


def _channels(data: bytes) -> list[tuple[str, np.dtype[Any]]]:
    at, channels = 0, []
    while data[at] != 0:
        name, at = _string(data, at)
        channels.append((name, DTYPES[struct.unpack_from("<i", data, at)[0]]))
        at += 16
    return channels


def _string(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode("latin-1"), end + 1


def _pixels(data: bytes, header: _Header, at: int) -> npt.NDArray[np.float32]:
    lines = LINES[header.compression]
    blocks = -(-header.height // lines)
    image = np.zeros((header.height, header.width), np.float32)
    line_bytes = sum(dtype.itemsize for _, dtype in header.channels) * header.width
    first = header.channels[0][1]
    for offset in struct.unpack_from(f"<{blocks}Q", data, at):
        line, size = struct.unpack_from("<ii", data, offset)
        row = line - header.first_line
        count = min(lines, header.height - row)
        block = data[offset + 8 : offset + 8 + size]
        if header.compression and size < count * line_bytes:
            block = _inflate(block)
        rows = np.frombuffer(block, np.uint8).reshape(count, line_bytes)
        values = np.ascontiguousarray(rows[:, : first.itemsize * header.width]).view(first)
        image[row : row + count] = values
    return image


def _inflate(block: bytes) -> bytes:
    """Unzip, undo the differences, and put the two interleaved halves together."""
    raw = np.frombuffer(zlib.decompress(block), np.uint8).astype(np.int64)
    raw[1:] -= 128
    whole = np.cumsum(raw).astype(np.uint8)
    half = (len(whole) + 1) // 2
    merged = np.empty_like(whole)
    merged[0::2], merged[1::2] = whole[:half], whole[half:]
    return merged.tobytes()


# --------------------------------------------------------------------------------------------------
# MIMIR-UW (Alvarez-Tunon et al., IROS 2023): simulated surveys in the EuRoC layout.
#
# ``SeaFloor/[auv0/]track0/{rgb,depth}/cam0/{data/<ns>.png|.exr, data.csv, sensor.yaml}`` and
# ``track0/pose_groundtruth/data.csv``: ``ns, x, y, z, qw, qx, qy, qz, ...`` of the body. A sensor's
# axes are x forward, y right, z down; depth is z.

APART_NS = 20_000_000
"""A picture has the pose of this moment at most before or after it: poses come at 30 to 210 Hz."""


def mimir(root: Path) -> list[Frames]:
    """One sequence for each camera of each track under ``root``.

    Raises:
        InputError: there is none, or a calibration or table cannot be read.
    """
    cameras = [path.parent for path in sorted(root.rglob("rgb/cam*/sensor.yaml"))]
    if not cameras:
        raise nothing_in(root, "MIMIR-UW track (rgb/cam0/sensor.yaml)")
    return [_camera(folder, root) for folder in cameras]


def _camera(folder: Path, root: Path) -> Frames:
    track, name = folder.parents[1], folder.name
    K, T_bc = _calibration(folder / "sensor.yaml")
    rows = table(track / "pose_groundtruth" / "data.csv", 8, ",")
    moments = rows[:, 0].astype(np.int64)
    readers = []
    for image in sorted((folder / "data").glob("*.png")):
        depth = track / "depth" / name / "data" / f"{image.stem}.exr"
        nearest = int(np.argmin(np.abs(moments - _moment(image))))
        if not depth.is_file() or abs(moments[nearest] - _moment(image)) > APART_NS:
            continue
        T_wb = pose(rows[nearest, 1:4], rows[nearest, 4:8])
        readers.append(partial(_mimir_frame, image, depth, K, T_wb @ T_bc))
    return Frames(str(folder.relative_to(root)), tuple(readers))


def _mimir_frame(
    image: Path,
    depth: Path,
    K: Array,  # [3, 3] px
    T_wc: Array,  # [4, 4] m
) -> Posed:
    return Posed(read_image(image), read_exr(depth), K, T_wc)


def _moment(image: Path) -> int:
    try:
        return int(image.stem)
    except ValueError as error:
        raise InputError(f"{image} is not named after its time in ns; unpack it again") from error


def _calibration(path: Path) -> tuple[Array, Array]:
    """K and T_bc of the camera's optical axes."""
    try:
        sensor = read_mapping(path, "calibration", "unpack it again")
        K = np.array(sensor["intrinsics"], dtype=np.float64).reshape(3, 3)
        T_bs = np.array(sensor["T_BS"], dtype=np.float64).reshape(4, 4)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is no calibration of a camera; unpack it again") from error
    return K, T_bs @ NED_TO_OPTICAL
