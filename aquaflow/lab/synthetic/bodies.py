"""What moves by itself in front of the camera: fish, and an arm of the vehicle.

They have no place in the map, and what they cover of the scene is not seen. Coordinates are the
survey frame with z up, as those of the scene's objects.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.objects import Rgb, Solid
from aquaflow.lab.synthetic.streams import stream

Array: TypeAlias = npt.NDArray[np.float64]

HALF_LENGTH_M = (0.05, 0.14)
"""Of fish: 10 to 28 cm, those that come close to a vehicle on a reef."""
SLENDER = (1.0, 0.2, 0.38)
"""Half sizes of a body over half its length: along, across, upright."""
DISTANCE_M = (0.45, 1.0)
"""From the camera where a fish crosses its view: between it and a floor 1.5 to 2 m away."""
SIDEWAYS = (0.35, 0.25)
"""Largest x / z and y / z there: within the picture at any of the usual focal lengths."""
SPEED_M_S = (0.1, 0.5)
"""About one to three body lengths a second, as fish cruise."""
CLIMB = 0.15
"""Largest rise over way of a fish."""
SCALES: tuple[Rgb, ...] = ((0.45, 0.42, 0.30), (0.55, 0.52, 0.50), (0.25, 0.30, 0.38))
STRIPES: Rgb = (0.08, 0.08, 0.10)
STRIPED = 0.55
"""How much of a fish the dark pattern covers (`Solid.covered`)."""
ARM_CENTRE_M = (0.12, 0.22, 0.5)
"""Right, down, forward of the camera: a manipulator below the dome, its hand in the picture."""
ARM_AXIS = (-0.35, -0.45, 0.82)
ARM_HALF_M, ARM_RADIUS_M = 0.3, 0.035
ARM_SWAY_M, ARM_PERIOD_S = (0.05, 0.03, 0.04), (7.0, 5.0, 11.0)
"""Of its way along the camera's axes: an operator who holds something."""
METAL: Rgb = (0.18, 0.18, 0.19)
GRIP: Rgb = (0.50, 0.30, 0.06)


class Bodies:
    """All that moves in a dive."""

    def __init__(
        self,
        config: SyntheticConfig,
        times_s: Array,  # [N] of the pictures
        R_sc: Array,  # [N, 3, 3] camera axes in the survey frame (z down)
        centres: Array,  # [N, 3] m, survey frame (z down)
    ) -> None:
        rng = stream(config.seed, "bodies")
        up = np.diag([1.0, 1.0, -1.0])
        self._t, self._R, self._centres = times_s, up @ R_sc, centres @ up
        self._arm = Arm(rng.uniform(0.0, 2.0 * np.pi, 3)) if config.arm else None
        self._fish = draw_fish(config.fish, times_s, self._R, self._centres, rng)

    def at(self, k: int) -> list[Solid]:
        """Those of picture ``k``."""
        fish = [each.shape(float(self._t[k])) for each in self._fish]
        if self._arm is None:
            return fish
        return fish + self._arm.shapes(float(self._t[k]), self._R[k], self._centres[k])


@dataclass(frozen=True)
class Fish:
    """One fish that swims straight on."""

    at: Array
    """[3] m, where it is at time ``t_s``."""
    t_s: float
    velocity: Array
    """[3] m/s"""
    half_length_m: float
    scales: Rgb
    pattern_m: float

    def shape(self, t_s: float) -> Solid:
        """The fish at a time of the dive."""
        along = self.velocity / np.linalg.norm(self.velocity)
        R = _axes(along, np.array([0.0, 0.0, 1.0]))
        a, b, c = (self.half_length_m * part for part in SLENDER)
        centre = self.at + self.velocity * (t_s - self.t_s)
        return Solid(
            "ellipsoid", centre, R, (a, b, c), self.scales, STRIPES, STRIPED,
            pattern_m=self.pattern_m,
        )  # fmt: skip


def draw_fish(
    count: int,
    times_s: Array,  # [N] of the pictures
    R: Array,  # [N, 3, 3] camera axes
    centres: Array,  # [N, 3] m
    rng: np.random.Generator,
) -> list[Fish]:
    """``count`` fish, each of which crosses the view at a time of its own."""
    found = []
    for _ in range(count):
        k = int(rng.integers(len(times_s)))
        z = rng.uniform(*DISTANCE_M)
        x, y = (z * rng.uniform(-side, side) for side in SIDEWAYS)
        heading = rng.uniform(0.0, 2.0 * np.pi)
        way = np.array([np.cos(heading), np.sin(heading), rng.uniform(-CLIMB, CLIMB)])
        velocity = rng.uniform(*SPEED_M_S) * way
        at = centres[k] + R[k] @ np.array([x, y, z])
        length, scales = rng.uniform(*HALF_LENGTH_M), SCALES[int(rng.integers(len(SCALES)))]
        pattern = rng.uniform(0.0, 2.0)
        found.append(Fish(at, float(times_s[k]), velocity, length, scales, pattern))
    return found


@dataclass(frozen=True)
class Arm:
    """An arm from below into the picture, that sways a little with respect to the camera."""

    phase: Array
    """[3] rad"""

    def shapes(
        self,
        t_s: float,
        R: Array,  # [3, 3] camera axes
        centre: Array,  # [3] m, of the camera
    ) -> list[Solid]:
        """The tube and the grip at its end."""
        turn = 2.0 * np.pi * t_s / np.array(ARM_PERIOD_S) + self.phase
        middle = np.array(ARM_CENTRE_M) + np.array(ARM_SWAY_M) * np.sin(turn)
        axis = np.array(ARM_AXIS) / np.linalg.norm(ARM_AXIS)
        axes = R @ _axes(axis, np.array([0.0, -1.0, 0.0]))
        tube = (ARM_HALF_M, ARM_RADIUS_M, ARM_RADIUS_M)
        grip = (2.0 * ARM_RADIUS_M, 2.0 * ARM_RADIUS_M, 0.8 * ARM_RADIUS_M)
        end = centre + R @ (middle + ARM_HALF_M * axis)
        return [
            Solid("cylinder", centre + R @ middle, axes, tube, METAL, METAL, 0.0, pattern_m=0.3),
            Solid("ellipsoid", end, axes, grip, GRIP, METAL, 0.3, pattern_m=0.9),
        ]


def _axes(
    along: Array,  # [3] unit vector
    upright: Array,  # [3]
) -> Array:
    """[3, 3] whose columns are ``along``, across it, and as upright as they can be."""
    across = np.cross(upright, along)
    across /= np.linalg.norm(across)
    return np.stack([along, across, np.cross(along, across)], axis=1)
