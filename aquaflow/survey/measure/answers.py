"""What ``aquaflow measure`` answers of marked points."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.shown_views import ShownViews
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.transfers import picture_out
from aquaflow.survey.export.ortho.ground import Ground, ground_of
from aquaflow.survey.measure.asked import Asked, GeodeticPoint, locate
from aquaflow.survey.measure.drawn_heights import Progress, draw_heights
from aquaflow.survey.measure.height_field import HeightField
from aquaflow.survey.measure.points import MeasuredPoints
from aquaflow.survey.measure.quantity import Quantity, Scale, scale_of
from aquaflow.survey.measure.roughness import MATCH_SIGMA, surface_ratio
from aquaflow.survey.measure.shapes import (
    LEAST_CORNERS,
    GroundProfile,
    area,
    path_length,
    plan_area,
    profile,
)
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.water.sightings import SOLID

Array = npt.NDArray[np.float64]
Shape = Literal["line", "area", "profile"]

MOST_STEPS = 400
"""Of a profile: more than a screen is wide in cells."""
REACH_VIEWS = 10
"""From which the width of a picture on the ground is taken."""


@dataclass(frozen=True)
class PointMeasurements:
    """Measurements of one set of points."""

    shape: Shape
    places: Array
    """[N, 3] of the points, in n."""
    quantities: dict[str, Quantity]
    """By name."""
    profile: GroundProfile | None = None
    notes: list[str] = field(default_factory=list)
    """What was left out, and why."""

    def to_json(self) -> dict[str, Any]:
        """One object."""
        data: dict[str, Any] = {
            "shape": self.shape, "points": self.places.tolist(),
            "measured": {name: q.to_json() for name, q in self.quantities.items()},
            "notes": self.notes,
        }  # fmt: skip
        if self.profile is not None:
            data["profile"] = {
                "along": self.profile.along.tolist(), "height": self.profile.height.tolist(),
                "sigma": self.profile.sigma.tolist(), "unit": self.profile.unit,
            }  # fmt: skip
        return data

    def rows(self) -> list[list[str]]:
        """A table with a head: the profile's heights, or the quantities."""
        if self.profile is not None:
            found = self.profile
            values = np.stack([found.along, found.height, found.sigma, found.low, found.high], 1)
            head = [f"{name}_{found.unit}".replace(" ", "_") for name in _COLUMNS]
            return [head, *([f"{v:.6g}" for v in row] for row in values)]
        lines = [["measured", "value", "sigma", "low_95", "high_95", "unit"]]
        for name, q in self.quantities.items():
            lines.append([name, *(f"{v:.6g}" for v in (q.value, q.sigma, q.low, q.high)), q.unit])
        return lines


_COLUMNS = ("along", "height", "sigma", "low_95", "high_95")


def answer(
    dive: Dive,
    asked: list[Asked],
    shape: Shape | None,
    work: Path,
    cell: float | None = None,
    progress: Progress | None = None,
) -> PointMeasurements:
    """Measure between points of a finished dive's largest sub-map.

    Args:
        shape: None: a line of two points, an area of more.
        work: folder of a file that ends with the call, where heights of the ground are needed.
        cell: side of the cells of these heights; None: found from the map's resolution.

    Raises:
        InputError: the dive has no map, or a point or the shape cannot be measured.
        ConfigError: the dive's settings cannot be read.
    """
    chosen = shape or ("line" if len(asked) < LEAST_CORNERS else "area")
    if chosen == "profile" and len(asked) != 2:
        raise InputError(f"a profile lies between 2 points, not {len(asked)}; give both ends")
    mapper, frame = dive.filled_map(), dive.frame
    drawn: HeightField | None = None
    ground: Ground | None = None
    notes: list[str] = []
    if chosen != "line" or any(isinstance(each, GeodeticPoint) for each in asked):
        try:
            ground = ground_of(frame, mapper)
            drawn = draw_heights(ShownViews(mapper), ground, work, cell, progress)
        except InputError as error:
            if ground is not None or chosen != "area":
                raise
            notes.append(f"no area on a plan, and no surface with relief: {error}")
    reach = drawn.reach if drawn is not None else width_seen(mapper, frame)
    points = locate(asked, mapper, frame, dive, drawn, ground, reach)
    scale = scale_of(frame)
    if chosen == "line":
        return PointMeasurements("line", points.places, {"length": path_length(points, scale)})
    if drawn is None or ground is None:
        measured = {"area": area(points, scale)}
        return PointMeasurements("area", points.places, measured, notes=notes)
    R_gn = ground.T_gm.R @ frame.T_nm.R.T
    if chosen == "profile":
        found = profile(_line(drawn, R_gn, points), R_gn[2], scale)
        length = path_length(points, scale)
        return PointMeasurements(
            "profile", points.places, {"length": length, "drop": found.drop}, found
        )
    return _area(drawn, R_gn, points, scale)


def width_seen(mapper: Mapper, frame: WorldFrame) -> float:
    """Width of what a picture shows, median over some views, in n's unit."""
    step = max(1, len(mapper.views) // REACH_VIEWS)
    widths = []
    for view in mapper.views[::step]:
        shown = mapper.show(view)
        z = picture_out(shown.z)[picture_out(shown.alpha) > SOLID]
        if len(z):
            widths.append(float(np.median(z)) * view.camera.width / view.camera.fx)
    if not widths:
        raise InputError("the dive's views show nothing of its map; map the dive again")
    return float(np.median(widths)) * frame.T_nm.scale


def _line(
    drawn: HeightField,
    R_gn: Array,  # [3, 3]
    ends: MeasuredPoints,
) -> MeasuredPoints:
    """Points of the ground between two ends, in n; raises InputError if there are none."""
    start, end = (R_gn @ place for place in ends.places)
    length = float(np.linalg.norm((end - start)[:2]))
    steps = int(np.clip(np.ceil(length / drawn.cell) + 1, 2, MOST_STEPS))
    flat = start[:2] + np.linspace(0.0, 1.0, steps)[:, None] * (end - start)[:2]
    heights, sigma = drawn.at(flat)
    known = np.isfinite(heights) & np.isfinite(sigma)
    if known.sum() < 2:
        raise InputError("the map has no ground between the points; choose others")
    places = np.column_stack([flat, heights])[known] @ R_gn
    up = np.outer(R_gn[2], R_gn[2])
    shared = sigma[known, None, None] ** 2 * up
    return MeasuredPoints(places, MATCH_SIGMA**2 * shared, shared, ends.reach)


def _area(
    drawn: HeightField,
    R_gn: Array,  # [3, 3]
    points: MeasuredPoints,
    scale: Scale,
) -> PointMeasurements:
    plan = plan_area(points, R_gn[2], scale)
    found, notes = {"area": area(points, scale), "plan_area": plan}, []
    try:
        ratio = surface_ratio(_within(drawn, (points.places @ R_gn.T)[:, :2]), scale.tilt_sigma_rad)
        value = plan.value * ratio.value
        low, high = (
            float(np.hypot(ratio.value * (plan.value - edge), plan.value * (ratio.value - end)))
            for edge, end in ((plan.low, ratio.low), (plan.high, ratio.high))
        )
        sigma = float(np.hypot(ratio.value * plan.sigma, plan.value * ratio.sigma))
        found["surface_area"] = Quantity(
            value, sigma, max(0.0, value - low), value + high, plan.unit
        )
    except InputError as error:
        notes.append(f"no surface with relief: {error}")
    return PointMeasurements("area", points.places, found, notes=notes)


def _within(
    drawn: HeightField,
    corners: Array,  # [N, 2] x, y on the ground
) -> HeightField:
    """The same without heights outside of an outline, by the even-odd rule."""
    x = drawn.grid.left + (np.arange(drawn.grid.width) + 0.5) * drawn.cell
    y = drawn.grid.top - (np.arange(drawn.grid.height) + 0.5) * drawn.cell
    inside = np.zeros((drawn.grid.height, drawn.grid.width), bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 == y1:
            continue
        rows = (y0 > y) != (y1 > y)
        crossing = x0 + (y - y0) * (x1 - x0) / (y1 - y0)
        inside ^= rows[:, None] & (x[None] < crossing[:, None])
    height, blurred = (np.where(inside, each, np.nan) for each in (drawn.height, drawn.blurred))
    return replace(drawn, height=height, blurred=blurred)
