"""Dives whose telemetry and pictures are out of step, and what the pose output sends of them.

Nothing is rendered: the camera path has the errors of tracking and an unknown scale
(``tests/telemetry/simulated_dives.py``); the estimator and the pose output are the real ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, Literal, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from aquaflow.config import FusionConfig
from aquaflow.config.service import PoseConfig
from aquaflow.geometry.alignment import align
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.live.vehicle.pose_output import PoseOutput
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.estimator import estimate
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.frames import FrameClass, Quality, Tracked
from aquaflow.types import KIND_OF, TelemetrySample
from tests.live.live_scenes import ToldFeed, frame_of
from tests.telemetry.simulated_dives import Swum, between, ground_of, stated_mounting, swum

Array = npt.NDArray[np.float64]
Fault: TypeAlias = Literal["constant", "step", "drift", "one instrument"]

FPS = 5.0
LONGEST_OFFSET_S, LASTS_S = 30.0, 45.0
"""Telemetry goes on for as long before and after the pictures as it may be out of step."""
ESTIMATES_S = (5.0, 8.0, 12.0, 20.0, 40.0)
"""Moments of the dive at which the metric frame is estimated anew: about every 20 keyframes."""
SENSORS = (
    ("depth", "attitude", "angular_rate", "velocity", "altitude"),
    ("depth", "attitude", "altitude"),
    ("depth", "attitude"),
    ("attitude", "altitude"),
    ("attitude", "velocity"),
    ("depth", "acceleration", "angular_rate", "altitude"),
    ("depth", "acceleration", "altitude"),
    ("acceleration", "altitude"),
    ("acceleration", "velocity"),
    ("depth", "velocity"),
)
"""A whole vehicle; one kind of length; gyro without attitude; neither."""


@dataclass(frozen=True)
class Case:
    """How telemetry is wrong in one dive."""

    seed: int
    offset_s: float
    kinds: tuple[str, ...]
    fault: Fault
    calm: bool
    """True for a vehicle that hardly turns."""
    altitude_s: float
    """Between two samples of the altimeter."""
    heard_s: tuple[float, float]
    """Telemetry is there from and until, on the pictures' clock."""

    @staticmethod
    def drawn(seed: int, right: bool = False) -> Case:
        """A random one; ``right``: with clocks that are right."""
        rng = np.random.default_rng(seed)
        size = float(np.exp(rng.uniform(np.log(0.2), np.log(LONGEST_OFFSET_S))))
        offset_s = size * float(rng.choice([-1.0, 1.0]))
        fault = cast(Fault, str(rng.choice(["constant", "step", "drift", "one instrument"],
                                           p=[0.7, 0.1, 0.1, 0.1])))  # fmt: skip
        calm, few = bool(rng.random() < 0.2), bool(rng.random() < 0.4)
        heard = (-np.inf, np.inf)
        if rng.random() < 0.2:
            cut = float(rng.uniform(5.0, 40.0))
            heard = (cut, np.inf) if rng.random() < 0.5 else (-np.inf, cut)
        kinds = SENSORS[seed % len(SENSORS)]
        spacing = float(rng.uniform(1.0, 2.5)) if few else 0.1
        if right:
            offset_s, fault = 0.0, "constant"
        return Case(seed, offset_s, kinds, fault, calm, spacing, heard)

    def stamped(self, kind: str, t_s: float) -> float:
        """What the telemetry's clock says at a moment of the pictures'."""
        if self.fault == "one instrument":
            return t_s + (self.offset_s if kind == self.kinds[-1] else 0.0)
        if self.fault == "step":
            return t_s + (self.offset_s if t_s > 0.4 * LASTS_S else 0.0)
        if self.fault == "drift":
            return t_s + self.offset_s * t_s / LASTS_S
        return t_s + self.offset_s

    @property
    def config(self) -> SyntheticConfig:
        """The dive."""
        rng = np.random.default_rng(self.seed)
        sway = {"roll_deg": 0.3, "pitch_deg": 0.3, "yaw_deg": 0.5} if self.calm else {}
        seconds = LASTS_S + 2.0 * LONGEST_OFFSET_S
        return SyntheticConfig.model_validate(
            {
                "seed": self.seed, "frames": int(seconds * FPS), "fps": FPS,
                "width": 64, "height": 48,
                "altitude_swing_m": float(rng.uniform(0.2, 1.0)),
                "altitude_m": 2.0 + float(rng.uniform(0.0, 1.0)),
                "speed_m_s": float(rng.uniform(0.2, 0.7)),
                "mounting_error_deg": float(rng.uniform(0.0, 4.0)),
                "turns": bool(rng.random() < 0.5),
                "rises": int(rng.integers(2, 12)),
                "scene": str(rng.choice(["reef", "flat_sand", "pipe"])), **sway,
            }
        )  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What became of one dive."""

    sent: int
    worst_sigmas: float
    """Largest error of the scale of a pose that was sent, in stated sigmas."""
    worst_relative: float
    first_s: float
    """Of the dive's clock, when the first pose went out; infinite for never."""
    stated_sigmas: float
    """Largest error of a scale that was stated as confirmed, sent or not, in stated sigmas."""
    said: str
    """Why nothing was sent at last."""


class Dive:
    """One dive as tracking and the estimator see it."""

    def __init__(
        self, case: Case, swum_as: Callable[[SyntheticConfig], Swum] | None = None
    ) -> None:
        kinds = tuple(dict.fromkeys(kind for kinds in SENSORS for kind in kinds))
        whole = swum(case.config, *kinds) if swum_as is None else swum_as(case.config)
        first, last = LONGEST_OFFSET_S, LONGEST_OFFSET_S + LASTS_S
        cut = between(whole.path, first, last, 1.0)
        path = CameraPath(cut.t_s - first, cut.R_mc, cut.p_m)
        inside = (whole.path.t_s >= first) & (whole.path.t_s <= last)
        self.truth_m = whole.dive.T_wc[inside, :3, 3]
        T_old = whole.path.R_mc[inside][0], whole.path.p_m[inside][0]
        ground = ground_of(whole, case.seed)
        near = np.abs(ground[:, None, :2] - whole.path.p_m[inside][None, ::10, :2]).max(axis=2)
        reach = 2.5 / whole.T_nm.scale
        ground = ground[near.min(axis=1) < reach][::2]
        self.ground = (ground - T_old[1]) @ T_old[0]
        self.case, self.path = case, path
        self.mounting = stated_mounting(whole.dive)
        last_s = -np.inf
        self.samples: list[tuple[float, TelemetrySample]] = []
        """With the moment of the pictures' clock at which each arrives."""
        for sample in whole.dive.samples:
            kind = KIND_OF[type(sample)]
            if kind not in case.kinds:
                continue
            t_s = 1e-9 * sample.t_ns - first
            if not case.heard_s[0] <= t_s <= case.heard_s[1]:
                continue
            if kind == "altitude":
                if t_s < last_s + case.altitude_s:
                    continue
                last_s = t_s
            stamp_ns = round(1e9 * case.stamped(kind, t_s))
            late_ns = sample.arrival_ns - sample.t_ns
            device = {"velocity": "dvl", "altitude": "ping"}.get(kind, "autopilot")
            moved = replace(sample, t_ns=stamp_ns, arrival_ns=stamp_ns + late_ns, source=device)
            self.samples.append((1e-9 * moved.arrival_ns, moved))

    def frame_at(self, t_s: float) -> tuple[WorldFrame, float]:
        """The metric frame as it is known then, and the true scale of the path until then."""
        telemetry = Telemetry()
        for arrives_s, sample in self.samples:
            if arrives_s <= t_s:
                telemetry.add(sample)
        known = self.path.t_s <= t_s
        path = CameraPath(self.path.t_s[known], self.path.R_mc[known], self.path.p_m[known])
        found = estimate(telemetry, path, FusionConfig(), self.mounting, lambda: self.ground)
        truth = align(path.p_m, self.truth_m[known], with_scale=True).T_target_source
        return found.frame, truth.scale


def outcome_of(case: Case, until_sent: bool = False) -> Outcome:
    """Swim the dive with the pose output switched on, or until the first pose was sent."""
    dive, feed, frame, true = Dive(case), ToldFeed(), WorldFrame.unknown(), 1.0
    out = PoseOutput(PoseConfig(enabled=True), feed, lambda sub_map: frame)
    worst = worst_relative = stated = 0.0
    first_s, due = np.inf, list(ESTIMATES_S)
    for k, t_s in enumerate(dive.path.t_s.tolist()):
        if due and t_s >= due[0]:
            frame, true = dive.frame_at(due.pop(0))
            if frame.metric and frame.scale_confirmed:
                error = abs(float(np.log(frame.T_nm.scale / true)))
                stated = max(stated, error / frame.scale_sigma)
        picture = replace(frame_of(k), t_ns=round(1e9 * t_s))
        T_mc = Sim3(dive.path.R_mc[k], dive.path.p_m[k])
        rated = Quality(inlier_share=0.8)
        latest = Tracked(picture, FrameClass.COMMON, 0, 0, T_mc, rated)
        before = out.sent
        out.update(cast(Any, SimpleNamespace(latest=latest)), t_s)
        if out.sent > before:
            error = abs(float(np.log(frame.T_nm.scale / true)))
            worst, worst_relative = (
                max(worst, error / frame.scale_sigma),
                max(worst_relative, error),
            )
            first_s = min(first_s, t_s)
            if until_sent:
                break
    said = "" if out.reason is None else f"{out.reason.value}: {out.scale_source}"
    return Outcome(out.sent, worst, worst_relative, first_s, stated, said)
