"""Surveys above even ground, of which every view's rectangle is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from aquaflow.config.service import CoverageConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.survey.coverage.footprint import BLOCKS, Footprint
from aquaflow.survey.coverage.page_view import PageView, page_view
from aquaflow.survey.coverage.sub_map_coverage import SubMapCoverage
from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]

CAMERA = CameraModel(480, 360, 400.0, 400.0, 240.0, 180.0)
ALTITUDE = 2.0
WIDTH, HEIGHT = ALTITUDE * 480 / 400, ALTITUDE * 360 / 400
"""Of what a picture shows on the ground, map units: 2.4 x 1.8."""
DOWN = np.diag([1.0, -1.0, -1.0])
"""Camera axes (right, down, forward) on a page whose z points up, top of the picture to +y."""
PAGE = np.eye(3)


def even(depth: float = ALTITUDE, camera: CameraModel = CAMERA) -> Footprint:
    """What a camera shows that looks straight onto a plane."""
    return Footprint(camera, np.full(BLOCKS, depth, np.float16))


def above(x: float, y: float, z: float = ALTITUDE, turn: float = 0.0, scale: float = 1.0) -> Sim3:
    """T_mc of a camera that looks down from there."""
    R = so3_exp(np.array([0.0, 0.0, turn])) @ DOWN
    return Sim3(R, np.array([x, y, z]), scale)


def lawnmower(lines: int, length: float, spacing: float, step: float) -> Array:
    """[N, 2] places along parallel lines, there and back along y, ``spacing`` apart along x, with
    the way from one to the next."""
    path: list[Array] = []
    for line in range(lines):
        y = np.arange(0.0, length + 1e-9, step)
        y = y if line % 2 == 0 else y[::-1]
        path.append(np.column_stack([np.full(len(y), line * spacing), y]))
    return np.concatenate(path)


def surveyed(path: Array, cells: int = 16) -> SubMapCoverage:  # path: [N, 2]
    """The coverage of a camera that was at each place of a path."""
    coverage = SubMapCoverage(cells, PAGE)
    for number, (x, y) in enumerate(path):
        coverage.put(number, even(), above(x, y))
        coverage.update()
    coverage.settle()
    return coverage


def views_at(
    places: Array,  # [..., 2]
    path: Array,  # [N, 2]
    margin: float = 0.0,
) -> Array:
    """[...] rectangles of the path that hold each place, each made larger by ``margin``."""
    offset = np.abs(places[..., None, :] - path)
    half = 0.5 * np.array([WIDTH, HEIGHT]) + margin
    return np.asarray((offset <= half).all(axis=-1).sum(axis=-1))


def sides_at(
    places: Array,  # [..., 2]
    path: Array,  # [N, 2]
) -> Array:
    """[...] different directions among the views of each place: within 10 degrees of the vertical,
    or one of four quarters in rings up to 25, 40 and 60 degrees, every other ring turned by 45."""
    offset = path - places[..., None, :]
    seen = (np.abs(offset) <= 0.5 * np.array([WIDTH, HEIGHT])).all(axis=-1)
    angle = np.degrees(np.arctan2(np.hypot(*np.moveaxis(offset, -1, 0)), ALTITUDE))
    ring = np.digitize(angle, [10.0, 25.0, 40.0, 60.0], right=True)
    turn = np.degrees(np.arctan2(offset[..., 1], offset[..., 0])) + np.where(ring % 2, 0.0, 45.0)
    side = np.where(ring == 0, 0, 10 * ring + np.floor(turn % 360.0 / 90.0))
    kinds = np.unique(side)
    return np.asarray(sum(((side == each) & seen).any(axis=-1) for each in kinds))


def metric(scale: float = 1.0, heading: float = 0.0) -> WorldFrame:
    """A level frame in metres for worlds whose page is x, y: n is north-east-down."""
    to_ned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    turn = so3_exp(np.array([0.0, 0.0, heading]))
    return WorldFrame(
        Sim3(turn @ to_ned, np.array([5.0, -3.0, 1.0]), scale), 1e-4 * np.eye(7), metric=True,
        level=True, north="true north",
    )  # fmt: skip


def survey_of(path: Array, limit: float | None = 2.4) -> PageView:  # path: [N, 2] east, north
    """What is shown of a survey 2 m above the ground, in metres, after its last keyframe."""
    frame = replace(metric(), T_nm=Sim3(metric().T_nm.R, np.zeros(3)))
    centres = np.column_stack([path, np.full(len(path), ALTITUDE)])
    view = page_view(0, surveyed(path), centres, frame, limit, CoverageConfig())
    assert view is not None
    return view
