"""Point clouds as files that survey programs read: E57, which scanners write too, and LAZ.

E57: ASTM E2807, written by libE57Format through pye57, whose own writer knows neither normals
nor chunks. Normals are those of the extension E57_NOR_surface_normals; sigma is an extension of
ours, which other readers pass over. One scan, whose translation is the origin, so that float32
resolves 0.1 mm within a kilometre of it.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError, first_line, load
from aquaflow.base.storage.atomic import atomic_write, fresh_file
from aquaflow.dive.point_cloud import CHUNK, CloudPoints, PointCloud

Progress = Callable[[int, int], None]

POSITIONS = ("cartesianX", "cartesianY", "cartesianZ")
COLOURS = ("colorRed", "colorGreen", "colorBlue")
NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")
SIGMA = "aquaflow:sigma"
EXTENSIONS = {
    "nor": "http://www.libe57.org/E57_NOR_surface_normals.txt",
    "aquaflow": "urn:aquaflow:e57:sigma",
}
"""Prefixes and their names; ours is the standard deviation along the ray, in the cloud's unit."""
AXES_OF_POSE = {"rotation": ("w", "x", "y", "z"), "translation": ("x", "y", "z")}


def write_e57(path: Path, cloud: PointCloud, progress: Progress | None = None) -> None:
    """Write the cloud, whole or not at all: on its UTM grid where it has one, else upright.

    Raises:
        InputError: pye57 is not installed, or the file cannot be written.
    """
    load("pye57", "an E57 file", "survey")
    libe57 = load("pye57.libe57", "an E57 file", "survey")
    with fresh_file(path) as part:  # the library opens files by name alone
        try:
            file = libe57.ImageFile(str(part), "w")
            try:
                _fill(libe57, file, cloud, progress)
            finally:
                file.close()
        except libe57.E57Exception as error:
            raise InputError(
                f"cannot write {path}: {first_line(error)}; give a folder with room that can be "
                "written to"
            ) from error


def _fill(libe57: Any, file: Any, cloud: PointCloud, progress: Progress | None) -> None:
    origin = np.round(cloud.placement.on_grid(np.zeros((1, 3)))[0])
    scans = _header(libe57, file, cloud.placement.wkt() or "")
    scan = _scan(libe57, file, cloud, origin)
    vector = libe57.CompressedVectorNode(
        file, _prototype(libe57, file), libe57.VectorNode(file, True)
    )
    scan.set("points", vector)
    scans.append(scan)
    columns, buffers = _buffers(libe57, file)
    writer, done = vector.writer(buffers), 0
    try:
        for points in cloud.chunks():
            count = len(points.positions)
            for name, values in _values(cloud, points, origin).items():
                columns[name][:count] = values
            writer.write(count)
            done += count
            if progress is not None:
                progress(done, len(cloud))
    finally:
        writer.close()  # before the file: the library ends the process otherwise


def _values(
    cloud: PointCloud,
    points: CloudPoints,
    origin: npt.NDArray[np.float64],  # [3]
) -> dict[str, npt.NDArray[np.generic]]:
    positions = cloud.placement.on_grid(points.positions) - origin
    normals = cloud.placement.turned_to_grid(points.normals)
    names = (*POSITIONS, *COLOURS, *NORMALS, SIGMA)
    columns = (*positions.T, *points.colours.T, *normals.T, points.sigma)
    return dict(zip(names, columns, strict=True))


def _header(libe57: Any, file: Any, wkt: str) -> Any:
    """What the standard asks of every file; returns the list of scans."""
    file.extensionsAdd("", libe57.E57_V1_0_URI)
    for prefix, name in EXTENSIONS.items():
        file.extensionsAdd(prefix, name)
    root, scans = file.root(), libe57.VectorNode(file, True)
    texts = {
        "formatName": "ASTM E57 3D Imaging Data File",
        "guid": f"{{{uuid.uuid4()}}}",
        "e57LibraryVersion": libe57.E57_LIBRARY_ID,
        "coordinateMetadata": wkt,
    }
    for name, text in texts.items():
        root.set(name, libe57.StringNode(file, text))
    root.set("versionMajor", libe57.IntegerNode(file, libe57.E57_FORMAT_MAJOR))
    root.set("versionMinor", libe57.IntegerNode(file, libe57.E57_FORMAT_MINOR))
    root.set("data3D", scans)
    root.set("images2D", libe57.VectorNode(file, True))
    return scans


def _scan(
    libe57: Any,
    file: Any,
    cloud: PointCloud,
    origin: npt.NDArray[np.float64],  # [3]
) -> Any:
    scan, pose = libe57.StructureNode(file), libe57.StructureNode(file)
    scan.set("guid", libe57.StringNode(file, f"{{{uuid.uuid4()}}}"))
    scan.set("name", libe57.StringNode(file, "AquaFlow"))
    scan.set("description", libe57.StringNode(file, cloud.placement.in_words()))
    numbers = {"rotation": (1.0, 0.0, 0.0, 0.0), "translation": tuple(origin)}
    for part, names in AXES_OF_POSE.items():
        node = libe57.StructureNode(file)
        for name, value in zip(names, numbers[part], strict=True):
            node.set(name, libe57.FloatNode(file, float(value)))
        pose.set(part, node)
    scan.set("pose", pose)
    limits = libe57.StructureNode(file)
    for name in COLOURS:
        limits.set(f"{name}Minimum", libe57.IntegerNode(file, 0))
        limits.set(f"{name}Maximum", libe57.IntegerNode(file, 255))
    scan.set("colorLimits", limits)
    return scan


def _prototype(libe57: Any, file: Any) -> Any:
    prototype = libe57.StructureNode(file)
    for name in (*POSITIONS, *NORMALS, SIGMA):
        prototype.set(name, libe57.FloatNode(file, 0.0, libe57.E57_SINGLE))
    for name in COLOURS:
        prototype.set(name, libe57.IntegerNode(file, 0, 0, 255))
    return prototype


def _buffers(libe57: Any, file: Any) -> tuple[dict[str, npt.NDArray[Any]], Any]:
    """Arrays of a chunk by field, and the library's view of them."""
    columns: dict[str, npt.NDArray[Any]] = {
        name: np.zeros(CHUNK, np.float32) for name in (*POSITIONS, *NORMALS, SIGMA)
    }
    columns |= {name: np.zeros(CHUNK, np.uint8) for name in COLOURS}
    buffers = libe57.VectorSourceDestBuffer()
    for name, column in columns.items():
        buffers.append(libe57.SourceDestBuffer(file, name, column, CHUNK, True, True))
    return columns, buffers


# --------------------------------------------------------------------------------------------------
# Point clouds as LAZ 1.4 files, which GIS and survey programs read.
#
# Format: ASPRS "LAS Specification 1.4 - R15", point format 7 (RGB), compressed by lazrs. Normals
# and sigma are extra bytes under the names that PDAL and CloudCompare know.

STEP = 1e-4
"""Of coordinates, in the cloud's unit: 0.1 mm, so that a millimetre resolves with a margin."""
LARGEST_INTEGER = 2**31 - 1
"""That a LAS coordinate can hold."""
POINT_FORMAT, VERSION = 7, "1.4"
"""RGB without near infrared; formats from 6 on belong to LAS 1.4."""
COLOUR_16_BIT = 257
"""0 to 255 becomes 0 to 65535, as the specification asks for."""
EXTRA = {
    "NormalX": "normal, x",
    "NormalY": "normal, y",
    "NormalZ": "normal, z",
    "sigma": "std. deviation along the ray",  # 31 bytes at most
}
"""Extra bytes, float32, and what they are."""
TEXT_AREA = ("LASF_Spec", 3)
"""User and number of the record that holds free text."""


def write_laz(path: Path, cloud: PointCloud, progress: Progress | None = None) -> None:
    """Write the cloud, whole or not at all: on its UTM grid where it has one, else upright.

    Raises:
        InputError: laspy or lazrs is not installed, or the file cannot be written.
    """
    laspy = load("laspy", "a LAZ file", "survey")
    load("lazrs", "a LAZ file", "survey")
    header, done = _las_header(laspy, cloud), 0
    with (
        atomic_write(path) as stream,
        laspy.open(stream, mode="w", header=header, closefd=False, do_compress=True) as writer,
    ):
        for points in cloud.chunks():
            writer.write_points(_record(laspy, header, cloud, points))
            done += len(points.positions)
            if progress is not None:
                progress(done, len(cloud))


def _las_header(laspy: Any, cloud: PointCloud) -> Any:
    where = cloud.placement
    header = laspy.LasHeader(point_format=POINT_FORMAT, version=VERSION)
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name, "f4", description=text) for name, text in EXTRA.items()]
    )
    header.offsets = np.round(where.on_grid(np.zeros((1, 3)))[0])
    step = max(STEP, 2.0 * cloud.reach() / LARGEST_INTEGER)  # twice: the grid is turned and scaled
    header.scales = np.full(3, step)
    header.generating_software = "AquaFlow"
    text = where.in_words().encode("ascii")
    header.vlrs.append(laspy.VLR(*TEXT_AREA, "coordinates", text))
    wkt = where.wkt()
    if wkt is not None:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
        header.global_encoding.wkt = True
    return header


def _record(laspy: Any, header: Any, cloud: PointCloud, points: CloudPoints) -> Any:
    record = laspy.ScaleAwarePointRecord.zeros(len(points.positions), header=header)
    record.x, record.y, record.z = cloud.placement.on_grid(points.positions).T
    record.red, record.green, record.blue = points.colours.T.astype(np.uint16) * COLOUR_16_BIT
    normals = cloud.placement.turned_to_grid(points.normals)
    for name, values in zip(EXTRA, (*normals.T, points.sigma), strict=True):
        record[name] = values
    record.return_number[:] = record.number_of_returns[:] = 1
    return record
