"""What the instruments of a survey's vehicle measure: the errors of any synthetic dive's.

The world has x and y in the seabed and z down, 0 at the surface; the vehicle looks down, and its
forward is -y.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator
from operator import attrgetter
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.motion import TrueBodyMotion
from aquaflow.lab.synthetic.mounting import Mountings, mountings_of
from aquaflow.lab.synthetic.path import turn_rate
from aquaflow.lab.synthetic.streams import Instrument
from aquaflow.lab.synthetic.survey import ALTITUDE_M, FPS, SWAY_M, SWAY_RAD, SWAY_S, SurveyPictures
from aquaflow.lab.synthetic.telemetry import measurement
from aquaflow.lab.synthetic.telemetry.series import draw_constants
from aquaflow.types import TelemetrySample

Array: TypeAlias = npt.NDArray[np.float64]

DEPTH_M = 20.0
"""Of the vehicle below the surface, without its sway."""
OMEGA = 2.0 * np.pi / SWAY_S


class SurveyPath:
    """A survey's motion as functions of time; see :class:`aquaflow.lab.synthetic.path.Path`."""

    def __init__(
        self,
        survey: SurveyPictures,
        R_bc: Array,  # [3, 3] camera axes in the body, in truth
    ) -> None:
        self._plan, self._R_bc = survey.plan, R_bc
        self.R_ws = np.eye(3)
        self.t_ws = np.array([0.0, 0.0, DEPTH_M + ALTITUDE_M])
        """m, of the mean seabed below the origin."""

    def centre_w(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3] m, the camera's centre in the world."""
        sway = np.sin(np.outer(t, OMEGA[:3])) * SWAY_M
        return np.column_stack([self._plan.place(t), np.full(len(t), DEPTH_M)]) + sway

    def velocity_w(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3] m/s of the camera over ground, in the world."""
        sway = OMEGA[:3] * np.cos(np.outer(t, OMEGA[:3])) * SWAY_M
        return np.column_stack([self._plan.velocity(t), np.zeros(len(t))]) + sway

    def R_wc(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3, 3] camera in the world."""
        turns = np.sin(np.outer(t, OMEGA[3:])) * SWAY_RAD
        return np.asarray(Rotation.from_rotvec(turns).as_matrix())

    def R_wb(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3, 3] body in the world."""
        return np.asarray(self.R_wc(t) @ self._R_bc.T)

    def rate_b(
        self,
        t: Array,  # [N] s
    ) -> Array:
        """[N, 3] rad/s in the body frame."""
        return turn_rate(self.R_wb, t)


class SurveyTelemetry:
    """The vehicle's depth cell, its attitude and its DVL."""

    def __init__(self, survey: SurveyPictures, seed: int = 0) -> None:
        self._config = SyntheticConfig.model_validate(
            {"seed": seed, "fps": FPS, "camera_pitch_deg": 90.0, "camera_position_m": (0, 0, 0)}
        )
        self.mountings: Mountings = mountings_of(self._config)
        """Of camera and DVL, as stated and in truth."""
        self.motion = TrueBodyMotion(SurveyPath(survey, self.mountings.R_bc), self.mountings)
        """The truth."""

    def samples(
        self, duration_s: float, kinds: Collection[Instrument]
    ) -> Iterator[TelemetrySample]:
        """Samples of ``kinds``, out of depth, attitude and velocity, in the order of arrival."""
        known = self.motion, draw_constants(self._config), self._config.telemetry
        measures: dict[Instrument, tuple[float, measurement.Measure]] = {
            "depth": (known[2].depth_hz, lambda t, rng: measurement.depth(t, *known, rng)),
            "attitude": (known[2].attitude_hz, lambda t, rng: measurement.attitude(t, *known, rng)),
            "velocity": (known[2].dvl_hz, lambda t, rng: measurement.velocity(t, *known, rng)),
        }
        each = [
            measurement.samples_of(kind, *measures[kind], duration_s, self._config)
            for kind in measures
            if kind in kinds
        ]
        return heapq.merge(*each, key=attrgetter("arrival_ns"))
