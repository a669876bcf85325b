"""Point clouds as LAZ 1.4 files, which GIS and survey programs read.

Format: ASPRS "LAS Specification 1.4 - R15", point format 7 (RGB), compressed by lazrs. Normals and
sigma are extra bytes under the names that PDAL and CloudCompare know.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors.extra import load
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.dive.point_cloud import CloudPoints, PointCloud

Progress = Callable[[int, int], None]

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
    header, done = _header(laspy, cloud), 0
    with (
        atomic_write(path) as stream,
        laspy.open(stream, mode="w", header=header, closefd=False, do_compress=True) as writer,
    ):
        for points in cloud.chunks():
            writer.write_points(_record(laspy, header, cloud, points))
            done += len(points.positions)
            if progress is not None:
                progress(done, len(cloud))


def _header(laspy: Any, cloud: PointCloud) -> Any:
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
