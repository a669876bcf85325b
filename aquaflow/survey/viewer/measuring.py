"""What lies between points that a browser picked, by :mod:`aquaflow.survey.measure`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.survey.measure.points import MeasuredPoints
from aquaflow.survey.measure.quantity import Quantity, Scale, scale_of
from aquaflow.survey.measure.shapes import area, path_length, plan_area, profile
from aquaflow.survey.viewer.picking import PickedGaussian, pick, within_reach
from aquaflow.survey.viewer.splats import ViewerSplats
from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]
Asked = dict[str, Any]

RANGE_SIGMA = 0.02
"""Relative 1 sigma of the map's ranges: 1.1 to 2.8 % on held-out views
(notes/2026-11-benchmarks.md)."""
PROFILE_POINTS = 64
"""Places along a profile."""
LEAST_SIGMA = 1e-9
"""Of a point, map units: none is exact."""


@dataclass(frozen=True)
class LengthUnit:
    """How lengths on the page are said."""

    scale: Scale
    metres: float = 1.0
    """Of the scale's unit in a unit of what is shown: live maps are shown in their own units."""
    has_vertical: bool = False
    """Up is against gravity, or for want of it away from the ground."""

    @staticmethod
    def of(frame: WorldFrame) -> LengthUnit:
        """Unit of a finished dive, whose files are in n."""
        return LengthUnit(scale_of(frame), has_vertical=frame.has_vertical)


@dataclass(frozen=True)
class MeasuringScene:
    """A scene in which points are measured."""

    splats: ViewerSplats
    cameras: Array
    """[M, 3] of the path."""
    width: float
    """Of what a picture shows, as a share of the range."""
    up: Array
    """[3] unit."""
    frame: LengthUnit


def measure(what: str, asked: Sequence[Asked], scene: MeasuringScene) -> Asked:
    """``words`` and ``quantities`` by name: distance, area or profile of what a browser asked.

    Raises:
        InputError: a point is none, or they are too few.
    """
    places = np.array([vector(point.get("place"), "a point") for point in asked])
    sigmas = np.array([_positive(point.get("sigma")) for point in asked])
    scale = scene.frame.scale
    if what == "distance":
        length = path_length(_points(places, sigmas, scene), scale)
        return _quantities_in_words({"distance": length})
    if what == "area":
        points = _points(places, sigmas, scene)
        found = {"area": area(points, scale)}
        if scene.frame.has_vertical:
            found["on a chart"] = plan_area(points, scene.up, scale)
        return _quantities_in_words(found)
    if what == "profile":
        return _profile(asked, places, sigmas, scene)
    raise InputError("this is neither a distance, an area nor a profile; reload the page")


def vector(given: Any, what: str) -> Array:
    """[3] finite numbers of a request.

    Raises:
        InputError: it holds something else.
    """
    numbers = isinstance(given, list) and len(given) == 3 and all(map(is_finite, given))
    if not numbers:
        raise InputError(f"{what} is not three finite numbers; point at the map again")
    return np.array(given, np.float64)


def ray_of(given: Asked) -> tuple[Array, Array, float]:
    """Origin [3], direction [3] and a pixel's angle, rad, of a request.

    Raises:
        InputError: it holds something else.
    """
    pixel = _positive(given.get("pixel_rad"))
    return vector(given.get("origin"), "the eye"), vector(given.get("direction"), "the ray"), pixel


def box_of(given: Any) -> tuple[Array, Array]:
    """Lowest and highest coordinates [3] of a box; None in place of a coordinate is an open side,
    in place of the box one that is open all around.

    Raises:
        InputError: it is no box.
    """
    corners = [[None] * 3] * 2 if given is None else given
    for corner in corners if isinstance(corners, list) and len(corners) == 2 else [None]:
        if not isinstance(corner, list) or len(corner) != 3:
            raise InputError("the crop is no box; reload the page")
        if not all(each is None or is_finite(each) for each in corner):
            raise InputError("a side of the crop is no number; reload the page")
    low, high = (
        np.array([side if each is None else each for each in corner], np.float64)
        for side, corner in zip((-np.inf, np.inf), corners, strict=True)
    )
    return low, high


def is_finite(given: Any) -> bool:
    """True of a number of a request that a float holds; of whole numbers there are larger ones."""
    try:
        return isinstance(given, (int, float)) and math.isfinite(given) and abs(given) < 1e12
    except OverflowError:
        return False


def _positive(given: Any) -> float:
    if not is_finite(given) or given < 0.0:
        raise InputError("a number of the request is none or negative; point at the map again")
    return float(given)


def _points(
    places: Array,  # [N, 3]
    sigmas: Array,  # [N]
    scene: MeasuringScene,
) -> MeasuredPoints:
    """In the unit of the dive's lengths. What the map errs, it errs by its cameras' ranges."""
    ranges = np.ones(len(places))
    if len(scene.cameras):
        apart = np.linalg.norm(places[:, None] - scene.cameras[None], axis=-1)
        ranges = apart.min(axis=1)
    metres = scene.frame.metres
    reach = max(metres * scene.width * float(np.median(ranges)), LEAST_SIGMA)
    own = metres * np.maximum(sigmas, LEAST_SIGMA)
    return MeasuredPoints.round(metres * places, own, metres * RANGE_SIGMA * ranges, reach)


def _quantities_in_words(quantities: dict[str, Quantity]) -> Asked:
    names = quantities if len(quantities) > 1 else {"": next(iter(quantities.values()))}
    lines = [f"{name}: {q.in_words()}" if name else q.in_words() for name, q in names.items()]
    return {
        "words": "\n".join(lines),
        "quantities": {name: quantity.to_json() for name, quantity in quantities.items()},
    }


def _profile(
    asked: Sequence[Asked],
    ends: Array,  # [N, 3]
    sigmas: Array,  # [N]
    scene: MeasuringScene,
) -> Asked:
    """Heights of the map between the first point and the last."""
    found = [_find(*ray) for ray in _rays(asked, ends, scene)]
    seen = [each for each in found if each is not None]
    if len(seen) < 2:
        raise InputError("the map shows nothing between these points; mark others")
    places = np.array([each.place for each in seen])
    points = _points(places, np.array([each.sigma for each in seen]), scene)
    line = profile(points, scene.up, scene.frame.scale)
    straight = path_length(_points(ends[[0, -1]], sigmas[[0, -1]], scene), scene.frame.scale)
    said = _quantities_in_words({"fall or rise": line.drop, "length": straight})
    parts = {"along": line.along, "height": line.height, "low": line.low, "high": line.high}
    rounded = {name: np.round(values, 6).tolist() for name, values in parts.items()}
    missing = PROFILE_POINTS - len(seen)
    note = f"\nnothing is mapped at {missing} of {PROFILE_POINTS} places" if missing else ""
    return said | {"words": said["words"] + note, "profile": rounded | {"unit": line.unit}}


def _rays(
    asked: Sequence[Asked],
    ends: Array,  # [N, 3]
    scene: MeasuringScene,
) -> list[tuple[ViewerSplats, Array, Array, float, float]]:
    """From straight above where there is a vertical; else from the eye that saw the first end.
    Each is as wide as half the way to the next."""
    shares = np.linspace(0.0, 1.0, PROFILE_POINTS)[:, None]
    line = (1.0 - shares) * ends[0] + shares * ends[-1]
    width = 0.5 * float(np.linalg.norm(ends[-1] - ends[0])) / PROFILE_POINTS
    if not scene.frame.has_vertical:
        eye, _, pixel = ray_of(asked[0])
        near = within_reach(scene.splats, eye, line[[0, -1]] - eye, width)
        ranges = np.maximum(np.linalg.norm(line - eye, axis=1), LEAST_SIGMA)
        beams = np.maximum(pixel, width / ranges)
        return [(near, eye, line[k] - eye, pixel, beams[k]) for k in range(len(line))]
    height = scene.splats.centres @ scene.up - float(line[0] @ scene.up)
    above = 2.0 * float(np.abs(height).max(initial=1.0))
    near = within_reach(scene.splats, ends[0], np.stack([ends[-1] - ends[0], scene.up]), width)
    return [(near, p + above * scene.up, -scene.up, 0.0, width / above) for p in line]


def _find(
    near: ViewerSplats,
    origin: Array,  # [3]
    direction: Array,  # [3]
    pixel_rad: float,
    beam_rad: float,
) -> PickedGaussian | None:
    """None where nothing is mapped."""
    try:
        return pick(near, origin, direction, pixel_rad, beam_rad)
    except InputError:
        return None
