"""A survey without end: a flat seabed, seen through water, one picture at a time.

A vehicle that keeps its heading follows a plan (survey_plan.py): up and down over lines that
overlap, as a mower does, so that every line but the first closes loops with the one before; or a
dive of an hour with all that befalls one. A picture takes some milliseconds and depends on its
index alone; nothing is kept, so that a dive may be as long as wanted.

Colour and relief are sums of smooth noise of several sizes. The noise is drawn on lattices whose
values are hashes of their place: no part of the seabed repeats, and none is stored.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.lab.synthetic.config import WaterType
from aquaflow.lab.synthetic.sensor import quantise
from aquaflow.lab.synthetic.survey_plan import Conditions, EndlessLines, SurveyPlan
from aquaflow.lab.synthetic.water import WATER_TYPES, Medium, Rgb
from aquaflow.types import Frame

Map: TypeAlias = npt.NDArray[np.float32]
Lattice: TypeAlias = npt.NDArray[np.uint32]
Box: TypeAlias = tuple[float, float, float, float]
"""m: least x and y of a piece of the seabed, greatest x and y."""

FOCAL_WIDTHS = 0.83
"""Focal length over the picture's width: 62 degrees across, as small underwater cameras have."""
FPS = 10.0
"""Pictures a second."""
ALTITUDE_M = 1.6
"""Above the seabed: a picture is 1.9 m wide and 1.4 m high."""
SWAY_M, SWAY_RAD = (0.04, 0.03, 0.06), (0.03, 0.04, 0.05)
"""Amplitude of the vehicle's unrest along and about x, y and z."""
SWAY_S = np.array([7.3, 11.9, 17.3, 5.3, 8.9, 13.7])
"""Its periods, three along and three about the axes."""
RELIEF = ((1.7, 0.10), (0.55, 0.04))
"""Spacing of a lattice and amplitude of its noise, m."""
TEXTURE = ((0.024, 0.3), (0.06, 0.45), (0.17, 0.45), (0.6, 0.4), (2.1, 0.3))
"""Spacing of a lattice in m, and amplitude of its noise in the logarithm of the brightness."""
TINT = ((0.9, 0.25),)
"""The same of red against blue."""
SAND = (0.42, 0.36, 0.27)
"""Mean radiance of the seabed, RGB."""
FIELDS = 8
"""Noises of one survey."""
INTERSECTIONS = 4
"""Steps of a ray's intersection; each leaves a tenth of the error, as the relief is gentle."""
NOISE = 0.004
"""Standard deviation of a pixel, of full scale: a byte."""
AMBIENT = 0.5
"""Share of the light on the seabed that is daylight, where there are lamps."""
LAMPS_M = (-0.3, 0.3)
"""Of the left and the right lamp beside the camera, along x."""
LAMP_POWER = 4.0
"""Of the cosine to its axis with which a lamp's light falls off: half at 33 degrees."""
SILT = (0.3, 0.27, 0.22)
"""Radiance of a dense cloud, RGB."""
SILT_SPACING, SILT_DRIFT_S = 0.25, 0.2
"""Of a cloud's structure, and its drift a second; in focal lengths over the picture."""
SILT_FIELD = 1 << 20
"""Number of the clouds' noise, plus the survey's: none of the seabed's."""
MARGIN = 3
"""Lattice points beyond a piece of the seabed, for the cubic interpolation."""


def survey_camera(width: int) -> CameraModel:
    """The survey's camera, with pictures of 4:3."""
    f, height = FOCAL_WIDTHS * width, width * 3 // 4
    return CameraModel(width, height, f, f, width / 2.0, height / 2.0)


@dataclass(frozen=True)
class _Noise:
    """Smooth noise over the plane: about -1 to 1, of a lattice that nobody holds."""

    spacing_m: float
    seed: int

    def __call__(
        self,
        x: Map,  # [H, W] m
        y: Map,  # [H, W] m
        box: Box,
    ) -> Map:
        """[H, W] at ``x`` and ``y``, all of which lie in ``box``."""
        first = [int(np.floor(low / self.spacing_m)) - MARGIN for low in box[:2]]
        last = [int(np.ceil(high / self.spacing_m)) + MARGIN for high in box[2:]]
        lattice = _hash_lattice(
            np.arange(first[0], last[0]), np.arange(first[1], last[1]), self.seed
        )
        column = (x / np.float32(self.spacing_m)) - np.float32(first[0])
        row = (y / np.float32(self.spacing_m)) - np.float32(first[1])
        return np.asarray(cv2.remap(lattice, column, row, cv2.INTER_CUBIC), np.float32)


def _hash_lattice(
    columns: npt.NDArray[np.int64],  # [W]
    rows: npt.NDArray[np.int64],  # [H]
    seed: int,
) -> Map:
    """[H, W] in [-1, 1): a mixed-up number for every place of a lattice."""
    across = _mix(columns.astype(np.uint32) ^ np.uint32(seed * 0x9E3779B9 & 0xFFFFFFFF))
    mixed = _mix(across[None, :] ^ _mix(rows.astype(np.uint32))[:, None])
    return mixed.astype(np.float32) * np.float32(2.0**-31) - np.float32(1.0)


def _mix(
    x: Lattice,  # [...]
) -> Lattice:
    """[...] a bijection of 32 bits in which every bit of ``x`` changes half of the others: Chris
    Wellons' lowbias32 (https://nullprogram.com/blog/2018/07/31/)."""
    x = (x ^ (x >> np.uint32(16))) * np.uint32(0x7FEB352D)
    x = (x ^ (x >> np.uint32(15))) * np.uint32(0x846CA68B)
    return np.asarray(x ^ (x >> np.uint32(16)), np.uint32)


Fields: TypeAlias = list[tuple[_Noise, float]]
"""Noises and their amplitudes."""


class SurveyPictures:
    """The pictures of a survey in the order in which they are taken; the area grows with them."""

    def __init__(
        self,
        width: int,
        seed: int = 0,
        water: WaterType = "coastal_1C",
        plan: SurveyPlan | None = None,
    ) -> None:
        """Pictures of ``width`` pixels along ``plan``; None: lines without end."""
        self.camera, self.plan = survey_camera(width), plan or EndlessLines()
        self._seed, self._water = seed, WATER_TYPES[water]
        self._rays = self.camera.unproject(self.camera.pixel_centres()).astype(np.float32)
        self._length = np.linalg.norm(self._rays, axis=-1).astype(np.float32)
        numbers = iter(range(FIELDS * seed, FIELDS * (seed + 1)))
        self._relief, self._texture, self._tint = (
            [(_Noise(spacing_m, next(numbers)), amplitude) for spacing_m, amplitude in layers]
            for layers in (RELIEF, TEXTURE, TINT)
        )
        self._silt = _Noise(SILT_SPACING, SILT_FIELD + seed)

    def name_of(self, index: int) -> str:
        """A frame's name in the table of frames."""
        return f"survey#{index}"

    def frames(self, count: int) -> Iterator[Frame]:
        """The first ``count`` frames, each made when it is asked for."""
        return (self.frame(index) for index in range(count))

    def frame(self, index: int) -> Frame:
        """What the camera sees at one moment."""
        t_ns = round(index / FPS * 1e9)
        return Frame(index, t_ns, t_ns, self._picture(index), self.camera)

    def T_wc(self, index: int) -> Sim3:
        """The true pose of a frame, m; x and y lie in the seabed, z points down to it."""
        x, y = self.plan.place(np.array(index / FPS)).tolist()
        sway = np.sin(2.0 * np.pi * index / FPS / SWAY_S)
        turn = so3_exp(sway[3:] * SWAY_RAD)
        return Sim3(turn, np.array([x, y, 0.0]) + sway[:3] * SWAY_M)

    def depth(self, index: int) -> Map:
        """[H, W] m along the optical axis, the truth of a frame."""
        return self._intersect_seabed(self.T_wc(index))[2]

    def seabed(
        self,
        x: Map,  # [H, W] m
        y: Map,  # [H, W] m
    ) -> tuple[Map, Map]:
        """Depth [H, W] of the seabed below z = 0, m, and its clean radiance [H, W, 3]."""
        box = float(x.min()), float(y.min()), float(x.max()), float(y.max())
        depth = np.float32(ALTITUDE_M) + _sum(self._relief, x, y, box)
        return depth, self._radiance(x, y, box)

    def _radiance(
        self,
        x: Map,  # [H, W] m
        y: Map,  # [H, W] m
        box: Box,
    ) -> Map:
        """[H, W, 3] of the seabed at ``x`` and ``y`` [H, W], m."""
        brightness = _sum(self._texture, x, y, box)
        tint = _sum(self._tint, x, y, box)
        log_colours = np.stack([brightness + tint, brightness, brightness - tint], axis=-1)
        return np.asarray(SAND, np.float32) * np.exp(log_colours)

    def _picture(self, index: int) -> npt.NDArray[np.uint8]:
        x, y, ahead, box = self._intersect_seabed(self.T_wc(index))
        radiance = self._radiance(x, y, box)
        now = self.plan.conditions(index / FPS)
        water = replace(
            self._water,
            beta_a=_times(now.turbidity, self._water.beta_a),
            b=_times(now.turbidity, self._water.b),
        )
        if now.lamps is None:
            seen = water.compose(radiance, ahead * self._length).astype(np.float32)
        else:
            seen = self._lit_by_lamps(index, radiance, ahead, water, now)
        rng = np.random.default_rng([self._seed, index])
        seen += np.float32(NOISE) * rng.standard_normal(seen.shape, np.float32)
        return quantise(seen)

    def _lit_by_lamps(
        self,
        index: int,
        radiance: Map,  # [H, W, 3]
        ahead: Map,  # [H, W] lengths of a ray
        water: Medium,
        now: Conditions,
    ) -> Map:
        """[H, W, 3] of a vehicle with lamps, through all that is in the way."""
        assert now.lamps is not None
        across, down = np.moveaxis(self._rays[..., :2], -1, 0)
        light = np.full(ahead.shape, AMBIENT, np.float32)
        for level, x in zip(now.lamps, LAMPS_M, strict=True):
            # On its axis at the survey's altitude a lamp gives half of what daylight leaves.
            aside = across * ahead - np.float32(x)
            squared = aside**2 + (down * ahead) ** 2 + ahead**2
            cosine = ahead**2 / squared
            share = level * (1.0 - AMBIENT) / len(LAMPS_M) * ALTITUDE_M**2
            light += np.float32(share) * cosine ** np.float32(LAMP_POWER / 2.0) / squared
        mean = AMBIENT + (1.0 - AMBIENT) * sum(now.lamps) / len(now.lamps)
        water = water.under(mean)
        seen = water.compose(radiance * light[..., None], ahead * self._length)
        if now.silt > 0.0:
            drift = np.float32(index / FPS * SILT_DRIFT_S)
            x, y = across + drift, np.ascontiguousarray(down)
            box = float(x.min()), float(y.min()), float(x.max()), float(y.max())
            hidden = now.silt * np.clip(0.6 + 0.7 * self._silt(x, y, box), 0.0, 0.97)[..., None]
            seen = (1.0 - hidden) * seen + hidden * np.asarray(SILT, np.float32)
        seen = (1.0 - now.veil) * seen + now.veil * np.asarray(water.B_inf, np.float32)
        return np.asarray(now.light * seen, np.float32)

    def _intersect_seabed(self, T_wc: Sim3) -> tuple[Map, Map, Map, Box]:
        """[H, W] each: x and y in m of where a pixel's ray meets the seabed, and how many of its
        lengths that is away; and a box around all of these places."""
        along_x, along_y, down = np.moveaxis(self._rays @ T_wc.R.T.astype(np.float32), -1, 0)
        x0, y0, z0 = T_wc.t.astype(np.float32)
        deepest = ALTITUDE_M + np.float32(sum(amplitude for _, amplitude in RELIEF))
        ahead = (deepest - z0) / down
        x, y = x0 + ahead * along_x, y0 + ahead * along_y
        box = float(x.min()), float(y.min()), float(x.max()), float(y.max())
        ahead = (ALTITUDE_M - z0) / down
        for _ in range(INTERSECTIONS):
            x, y = x0 + ahead * along_x, y0 + ahead * along_y
            ahead = (ALTITUDE_M + _sum(self._relief, x, y, box) - z0) / down
        return x, y, ahead, box


def _times(factor: float, rgb: Rgb) -> Rgb:
    red, green, blue = rgb
    return factor * red, factor * green, factor * blue


def _sum(
    fields: Fields,
    x: Map,  # [H, W] m
    y: Map,  # [H, W] m
    box: Box,
) -> Map:
    """[H, W] of all ``fields`` at ``x`` and ``y``, each times its amplitude."""
    total = np.zeros_like(x)
    for noise, amplitude in fields:
        total += np.float32(amplitude) * noise(x, y, box)
    return total
