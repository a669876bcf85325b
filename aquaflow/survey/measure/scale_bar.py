"""A length that a person marked in a finished dive: two points of a picture, or of the map.

A finished dive keeps its Gaussians and the poses of the mapped views, but no keyframe's depths: a
point of a picture is where its ray meets the map as the renderer draws it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.base.storage.dive_status import refuse_unfinished
from aquaflow.dive.dive import Dive
from aquaflow.dive.restored import refuse_outside, view_of_frame
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.views import View
from aquaflow.survey.measure.picked import (
    CLICK_SIGMA_PX,
    RANGE_SIGMA,
    measure_pixels,
)
from aquaflow.survey.measure.reframing import (
    Progress,
    measure_anew,
    metric,
    reframe,
    why_not_metric,
)
from aquaflow.telemetry.known_lengths.known_length import (
    KnownLength,
    LengthScale,
    read_known_lengths,
    scale_of,
    with_length,
    write_known_lengths,
)

POINT_SIGMA = 0.01
"""Of a point marked in the viewer, as a share of the marked length (judgement: a splat has a
size)."""
LEAST_LENGTH_PX = 10.0
"""Between two points of a picture; nearer ones are the same, but for the click."""


def between_pixels(
    dive: Dive,
    frame: int,
    start: tuple[float, float],
    end: tuple[float, float],
    length_m: float,
    sigma_m: float,
) -> KnownLength:
    """The length between two points, in px of the mapped picture of a frame.

    Raises:
        InputError: the dive has no map, did not map the frame, or the map is not there.
        ConfigError: the dive's settings cannot be read.
    """
    mapper, view, sub_map = _find_mapped_view(dive, frame)
    points = np.array([start, end], np.float64)
    refuse_outside(view, points)
    if np.linalg.norm(points[1] - points[0]) < LEAST_LENGTH_PX:
        raise InputError(
            f"the two points are less than {LEAST_LENGTH_PX:.0f} pixels apart; mark a longer length"
        )
    a, b = measure_pixels(mapper, view, points)
    length = float(np.linalg.norm(b.place - a.place))
    along = (b.place - a.place) / length
    click = CLICK_SIGMA_PX / view.camera.fx * float(np.hypot(a.range, b.range))
    # The ranges of one picture may err together, or apart: the sum of both covers either.
    apart = float(np.hypot(along @ a.ray * a.sigma, along @ b.ray * b.sigma))
    sigma = float(np.hypot(np.hypot(click, apart), RANGE_SIGMA * length))
    source = "scale bar {:g},{:g} to {:g},{:g}".format(*points.ravel())
    return KnownLength(frame, source, length, sigma, length_m, sigma_m, sub_map)


def between_points(
    dive: Dive,
    start: tuple[float, float, float],
    end: tuple[float, float, float],
    length_m: float,
    sigma_m: float,
) -> KnownLength:
    """The length between two points of the map of the largest sub-map, as map.ply has them.

    Raises:
        InputError: the dive has no table of its frames, its metric.json is damaged, or the points
            are the same.
    """
    metres_per_unit = dive.frame.T_nm.scale
    length = float(np.linalg.norm(np.subtract(end, start))) / metres_per_unit
    if not np.isfinite(length) or length <= 0.0:
        raise InputError("the two points are one and the same; mark both ends of a length")
    source = "scale bar {:g},{:g},{:g} to {:g},{:g},{:g}".format(*start, *end)
    sub_map = _largest(_sub_maps(dive))
    return KnownLength(-1, source, length, POINT_SIGMA * length, length_m, sigma_m, sub_map)


def _find_mapped_view(dive: Dive, frame: int) -> tuple[Mapper, View, int]:
    """The map that has a view of the frame, the view, and the sub-map's number."""
    sub_maps = _sub_maps(dive)
    if frame not in sub_maps:
        raise InputError(f"frame {frame} of {dive} has no pose; choose another --frame")
    number, largest = sub_maps[frame], _largest(sub_maps)
    dive.require()
    mapper = dive.map(None if number == largest else number)
    return mapper, view_of_frame(mapper, frame, dive), number


def _sub_maps(dive: Dive) -> dict[int, int]:
    """Sub-map by frame index, of the frames that have one."""
    return {row.index: row.sub_map for row in dive.frames if row.sub_map is not None}


def _largest(sub_maps: dict[int, int]) -> int:
    counts = Counter(sub_maps.values())
    return max(counts, key=lambda number: (counts[number], -number), default=0)


# --------------------------------------------------------------------------------------------------
# A length that a person marked in a finished dive: kept, and the dive brought to metres by it.


@dataclass(frozen=True)
class Marked:
    """What became of it."""

    known: KnownLength
    together: LengthScale
    """With all other known lengths of the sub-map."""
    unchanged: str | None
    """Why the dive's files keep their unit, in a sentence; None if they are in metres now."""

    def in_words(self) -> str:
        """Sentences about one map unit."""
        known, together = self.known, self.together
        said = f"1 map unit is {_plus_minus(known.metres_per_unit, known.relative_sigma)}."
        if together.used + len(together.rejected) > 1:
            against = f", {len(together.rejected)} contradicting" if together.rejected else ""
            all_of_them = _plus_minus(together.metres_per_unit, together.relative_sigma)
            said += f"\nWith all known lengths ({together.used} used{against}): {all_of_them}."
        return said


def keep_length(dive: Path, known: KnownLength, progress: Progress | None = None) -> Marked:
    """Write ``known`` into the dive, and rescale its files where nothing speaks against it.

    The ground is measured anew then: on cells of so many centimetres, as other dives are.

    Raises:
        InputError: the dive is not finished, or a file of it cannot be read or written.
    """
    refuse_unfinished(dive)
    lengths = with_length(read_known_lengths(dive), known)
    write_known_lengths(dive, lengths)
    members = [each for each in lengths if each.sub_map == known.sub_map]
    together = scale_of(members)
    assert together is not None  # of one length at least
    read = Dive(dive)
    frame = read.metric_frames.get(known.sub_map)
    unchanged = why_not_metric(frame, together)
    if frame is not None and unchanged is None:
        reframe(read, known.sub_map, metric(frame, members, together))
        if known.sub_map == read.main:
            measure_anew(dive, progress)
    return Marked(known, together, unchanged)


def _plus_minus(metres: float, relative_sigma: float) -> str:
    return f"{metres:.4g} m +- {metres * relative_sigma:.2g} m (1 sigma)"
