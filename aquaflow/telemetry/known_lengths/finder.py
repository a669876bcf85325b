"""All configured objects of known size in a dive: found once, measured with the poses of now.

Boards are measured in board_size.py, two laser beams here."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.config.telemetry import FusionConfig, LasersConfig
from aquaflow.telemetry.known_lengths.board_size import (
    BoardDetector,
    BoardSighting,
    BoardView,
    board_lengths,
)
from aquaflow.telemetry.known_lengths.known_length import KnownLength

Array = npt.NDArray[np.float64]


class KnownLengthFinder:
    """Keeps where the objects were seen, a kilobyte a picture, and no picture."""

    def __init__(self, config: FusionConfig) -> None:
        self._detector = BoardDetector(config.boards)
        self._lasers = config.lasers
        self._boards: list[BoardSighting] = []
        self._dots: list[DotCandidates] = []

    def look(
        self,
        frame_index: int,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB, undistorted
    ) -> Array:
        """Look for the objects in a picture: 6 to 9 ms of CPU for each at 640 x 480 px.

        Returns [N, 2] where something was seen: there the picture's depth is worth keeping.
        """
        boards = self._detector(frame_index, image)
        self._boards += boards
        seen = [each.pixels for each in boards]
        if self._lasers is not None:
            dots = find_dots(frame_index, image, self._lasers.colour)
            if len(dots.pixels):
                self._dots.append(dots)
                seen.append(dots.pixels)
        return np.concatenate([np.zeros((0, 2)), *seen])

    def __bool__(self) -> bool:
        """True once something was seen."""
        return bool(self._boards or self._dots)

    def copy(self) -> KnownLengthFinder:
        """What was seen until now, to be measured by another thread."""
        other = copy(self)
        other._boards, other._dots = list(self._boards), list(self._dots)
        return other

    def lengths(self, view_of: Callable[[int], BoardView | None]) -> list[KnownLength]:
        """What was seen until now, measured in the map as it is now.

        ``view_of`` gives a frame's place by its index; None for a frame without a pose.
        """
        lengths = board_lengths(self._boards, view_of)
        if self._lasers is not None:
            lengths += laser_lengths(self._dots, view_of, self._lasers)
        return lengths

    def count_seen(self, view_of: Callable[[int], BoardView | None]) -> Counter[tuple[int, str]]:
        """Pictures with a pose that show each object, by sub-map and name."""
        found: Counter[tuple[int, str]] = Counter()
        names = [(each.frame_index, each.name) for each in self._boards]
        for frame_index, name in [*names, *((dots.frame_index, DOTS) for dots in self._dots)]:
            view = view_of(frame_index)
            if view is not None:
                found[view.sub_map, name] += 1
        return found


# --------------------------------------------------------------------------------------------------
# The spacing of two laser beams in the map.
#
# A beam parallel to the optical axis goes through the same point of every plane across the axis, so
# that its dot lies on one half-line from the principal point, the further out the nearer the
# surface, and inverse depth times distance from the principal point is the same in every picture.
# Both hold only for the beams; spots of their colour on the sea floor, and dirt on the window,
# break one of the two.

DOTS = "laser dots"
"""Their name in the report."""
LEAST_PICTURES = 5
"""In which both dots lie where the beams go; fewer do not show where that is."""
LINE_PX = 3.0
"""From a beam's line that a dot may lie: its centre to 1 px, the axes of beams and camera."""
NEAREST_PX = 8.0
"""To the principal point; nearer dots have no direction."""
LARGEST_DEVIATION = 4.0
"""Sigmas from the median beam offset at which a spot is not the beam's dot."""
LEAST_SPREAD = 0.02
"""Relative, of the beam offsets: what a sound depth may differ by beyond what it states."""
LEAST_HEIGHTS = 0.1
"""Natural logarithm of the largest over the least depth of a beam's dots: pictures from one height
do not show whether a spot is a dot on the sea floor or dirt on the window."""
LEAST_SLOPE = 0.5
"""Of the logarithm of a dot's distance from the image centre over that of the depth, negated: 1 for
a beam, 0 for dirt."""
DOT_SIGMA_PX = 1.0
"""1 sigma of a dot's centre against the beam: speckle, and the slope it falls on (judgement)."""
MOST_HYPOTHESES = 500
"""Directions that are tried for a beam; each is one candidate of one picture."""


@dataclass(frozen=True)
class _Dot:
    """A candidate with its depth."""

    picture: int
    sub_map: int
    pixel: Array
    """[2] from the principal point, over the focal lengths and times fx: px."""
    offset: Array
    """[2] of a beam that made it, in map units."""
    sigma: float
    """Relative, of the offset's length by depth."""
    z: float
    """Depth, map units."""


def laser_lengths(
    pictures: Sequence[DotCandidates],
    view_of: Callable[[int], BoardView | None],
    lasers: LasersConfig,
) -> list[KnownLength]:
    """One length for each picture that shows both dots; none where the beams are not found.

    ``view_of`` gives a frame's place by its index; only views with a depth of their own count.
    """
    dots = [dot for number, each in enumerate(pictures) for dot in _dots(number, each, view_of)]
    first = _beam(dots)
    taken = {id(dot) for dot in first.values()}
    second = _beam([dot for dot in dots if id(dot) not in taken])
    both = sorted(first.keys() & second.keys())
    beams = [[beam[number] for number in both] for beam in (first, second)]
    if len(both) < LEAST_PICTURES or not all(_moves_as_a_beam(beam) for beam in beams):
        return []
    pairs = [(pictures[number].frame_index, first[number], second[number]) for number in both]
    return [_length(index, a, b, lasers, view_of) for index, a, b in pairs]


def _dots(
    number: int, picture: DotCandidates, view_of: Callable[[int], BoardView | None]
) -> list[_Dot]:
    view = view_of(picture.frame_index)
    if view is None or not len(picture.pixels):
        return []
    rho, variance = view.depth_at(picture.pixels)
    rays = view.camera.unproject(picture.pixels)[:, :2]
    dots = []
    for ray, inverse, spread in zip(rays, rho, variance, strict=True):
        if np.isfinite(spread) and np.linalg.norm(ray) * view.camera.fx > NEAREST_PX:
            z = view.T_wc.scale / inverse
            sigma = float(np.sqrt(spread) / inverse)
            dots.append(_Dot(number, view.sub_map, ray * view.camera.fx, ray * z, sigma, float(z)))
    return dots


def _beam(dots: Sequence[_Dot]) -> dict[int, _Dot]:
    """The dot of one beam in each picture that shows it: by the half-line with the most pictures,
    of those whose offset from the axis agrees."""
    best: dict[int, _Dot] = {}
    for tried in dots[:: max(1, len(dots) // MOST_HYPOTHESES)]:
        direction = tried.pixel / np.linalg.norm(tried.pixel)
        on_line = [dot for dot in dots if _is_on(dot, direction)]
        agreed = _agreeing(on_line)
        if len(agreed) > len(best):
            best = agreed
    return best


def _is_on(
    dot: _Dot,
    direction: Array,  # [2] unit
) -> bool:
    along = float(direction @ dot.pixel)
    across = abs(float(direction[0] * dot.pixel[1] - direction[1] * dot.pixel[0]))
    return along > 0.0 and across < LINE_PX


def _agreeing(dots: Sequence[_Dot]) -> dict[int, _Dot]:
    """By picture, the dots whose offset is that of most; sub-maps have units of their own."""
    kept: dict[int, _Dot] = {}
    for sub_map in {dot.sub_map for dot in dots}:
        members = [dot for dot in dots if dot.sub_map == sub_map]
        logs = np.log([float(np.linalg.norm(dot.offset)) for dot in members])
        centre = float(np.median(logs))
        for dot, log in zip(members, logs, strict=True):
            deviation = abs(float(log) - centre)
            if deviation > LARGEST_DEVIATION * float(np.hypot(dot.sigma, LEAST_SPREAD)):
                continue
            before = kept.get(dot.picture)
            if before is None or deviation < _deviation(before, centre):
                kept[dot.picture] = dot
    return kept


def _deviation(dot: _Dot, centre: float) -> float:
    return abs(float(np.log(np.linalg.norm(dot.offset))) - centre)


def _moves_as_a_beam(dots: Sequence[_Dot]) -> bool:
    """True if the dots move outwards as the surface comes nearer."""
    sub_maps = np.array([dot.sub_map for dot in dots])
    depths = np.log([dot.z for dot in dots])
    radii = np.log([float(np.linalg.norm(dot.pixel)) for dot in dots])
    for sub_map in np.unique(sub_maps):
        members = sub_maps == sub_map
        depths[members] -= depths[members].mean()
        radii[members] -= radii[members].mean()
    if np.ptp(depths) < LEAST_HEIGHTS:
        return False
    return bool(-(depths @ radii) > LEAST_SLOPE * (depths @ depths))


def _length(
    frame_index: int,
    a: _Dot,
    b: _Dot,
    lasers: LasersConfig,
    view_of: Callable[[int], BoardView | None],
) -> KnownLength:
    view = view_of(frame_index)
    assert view is not None
    between = a.offset - b.offset
    length = float(np.linalg.norm(between))
    unit = between / length
    pixel = DOT_SIGMA_PX / view.camera.fx
    # Both depths come from one pointmap and may err together: sigmas add up, not their squares.
    depth = abs(float(unit @ a.offset)) * a.sigma + abs(float(unit @ b.offset)) * b.sigma
    map_sigma = float(np.hypot(depth, pixel * np.hypot(a.z, b.z)))
    metres = lasers.spacing_m / length
    lean = np.radians(lasers.parallel_sigma_deg) * metres * float(np.hypot(a.z, b.z))
    sigma_m = float(np.hypot(lasers.sigma_m, lean))
    return KnownLength(frame_index, DOTS, length, map_sigma, lasers.spacing_m, sigma_m, a.sub_map)


# --------------------------------------------------------------------------------------------------
# Laser dots in a picture: small, bright, and of the laser's colour.

CHANNEL = {"red": 0, "green": 1, "blue": 2}
LEAST_CHROMA = 40
"""Grey levels by which the colour stands out of the other two around a dot: more than any sea floor
does over a few pixels (judgement)."""
LEAST_PEAK = 200
"""Grey levels of the colour in the dot, which is far brighter than what it falls on."""
LEAST_AREA_PX = 4
LARGEST_SHARE = 2e-3
"""Of the picture's pixels: a dot of 25 px radius at 1280 x 720."""
LEAST_FILL = 0.5
"""Area over that of the box around; a disc has 0.79."""
LONGEST = 3.0
"""Length over width of the box: a dot on a slope is an ellipse."""
CORE_PX = 5
"""Closes the white core of a dot that saturates all three channels."""
MOST_DOTS = 12
"""Candidates of one picture; the brightest are kept."""


@dataclass(frozen=True)
class DotCandidates:
    """What may be laser dots in one picture."""

    frame_index: int
    pixels: Array
    """[N, 2] centres, brightest first."""


def find_dots(
    frame_index: int,
    image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    colour: Literal["red", "green", "blue"],
) -> DotCandidates:
    """Spots of the colour, each to a fraction of a pixel."""
    channel = CHANNEL[colour]
    own = image[..., channel]
    others = np.max(np.delete(image, channel, axis=2), axis=2)
    coloured = cv2.subtract(own, np.ascontiguousarray(others)) > LEAST_CHROMA
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (CORE_PX, CORE_PX))
    spots = cv2.morphologyEx(coloured.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(spots)
    found: list[tuple[float, Array]] = []
    for label in range(1, count):
        x, y, w, h, area = (int(each) for each in boxes[label])
        if not _is_dot(w, h, area, own.size):
            continue
        inside = labels[y : y + h, x : x + w] == label
        bright = np.where(inside, own[y : y + h, x : x + w], 0).astype(np.float64)
        if bright.max() >= LEAST_PEAK:
            found.append((float(bright.sum()), _centre(bright) + np.array([x, y])))
    found.sort(key=lambda each: -each[0])
    centres = [centre for _, centre in found[:MOST_DOTS]]
    return DotCandidates(frame_index, np.array(centres, np.float64).reshape(-1, 2))


def _is_dot(w: int, h: int, area: int, pixels: int) -> bool:
    compact = area >= LEAST_FILL * w * h and max(w, h) <= LONGEST * min(w, h)
    return compact and LEAST_AREA_PX <= area <= LARGEST_SHARE * pixels


def _centre(
    bright: Array,  # [h, w]
) -> Array:
    """[2] the centre of the light, px from the corner of the box."""
    rows, columns = np.indices(bright.shape) + 0.5
    total = float(bright.sum())
    return np.array([float((columns * bright).sum()), float((rows * bright).sum())]) / total
