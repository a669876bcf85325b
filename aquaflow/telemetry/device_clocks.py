"""How far each device's clock is from the pictures', as the rotations of both show it.

Telemetry is placed by its stamps, which are wrong where a stream shows the past, a link holds
samples back, or a clock steps. Camera and vehicle are one body, so both turn alike: the path is cut
into pieces, and in each the offset is searched at which a device's gyro or attitude turns as the
camera does. A device without either has the clock of one that has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from aquaflow.telemetry.building import USED
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.solve import TelemetryProblem
from aquaflow.telemetry.telemetry import Series, Telemetry, device_of
from aquaflow.telemetry.time_offset import (
    DRIFT_SIGMA,
    NotSynchronisedError,
    TimeOffset,
    UnlikeError,
    estimate_time_offset,
)
from aquaflow.telemetry.turns import SHORTEST_OVERLAP_S, Turns, best_turns
from aquaflow.telemetry.world_frame import SourceReport, WorldFrame
from aquaflow.types import KINDS, AngularRate, Attitude

Array = npt.NDArray[np.float64]

PIECE_S = 12.0
"""Of the path: two cycles of an ROV's sway, which a gyro or an attitude filter finds again (in 10 s
of video, all of 100 simulated pairs)."""
MOST_PIECES = 12
"""Evenly along the path: each costs 20 ms, and a clock that is right stays right mostly."""
REACH_S = 60.0
"""Offsets up to here are searched; streams with a longer delay were not heard of."""
NEGLIGIBLE_S = 0.1
"""An ROV turns by less than a degree in it, and rises by 3 cm: samples are left where they are."""
LARGEST_STEP_S = 0.25
"""Between the offsets of two pieces, or of the two ends of one; where they differ by more, the
samples between the two have no time that is known."""
LATENCY_S = 0.02
"""1 sigma of the moment of a depth or a velocity against the rotations of the same device: the
MS5837 converts for 2 x 18 ms (data sheet), a DVL's ping takes as long to the ground and back."""
EVIDENT_DRIFT = 3.0
"""Sigmas from which a drift within a piece is no matter of noise."""
LEAST_EVIDENT_RAD_S = np.radians(1.0)
"""RMS rate of camera and vehicle from which their being unlike is no matter of noise: smoothed,
poses have 0.1 and attitudes 0.3 degrees/s."""
LEAST_MEASURED = 0.5
"""Share of a piece; of a device that was silent nothing can be unlike."""

MEASURED_IN_TIME = ("depth", "velocity", "altitude")
"""Kinds that know metres and say nothing if their moment is not known."""
MOVED_IN_TIME = ("depth", "velocity")
"""Of these the kinds whose metres are a movement: another moment has another one, and a clock at
another rate makes it faster."""
SHOWN_BY_THE_PATH = ("position", "length")
"""Kinds that need no rotation: fixes at other moments do not lie along the path, and what a picture
shows of known size has the picture's own time."""


@dataclass(frozen=True)
class DeviceClockEstimate:
    """What the rotations of one device say of its clock."""

    device: str
    at_s: Array = field(default_factory=lambda: np.empty(0))
    """[K] its stamps in the middle of the pieces at which an offset was found, rising."""
    offset_s: Array = field(default_factory=lambda: np.empty(0))
    """[K] pictures' time less its stamps."""
    sigma_s: Array = field(default_factory=lambda: np.empty(0))
    """[K]"""
    drift: Array = field(default_factory=lambda: np.empty(0))
    """[K] growth of the offset within each piece, s/s."""
    drift_sigma: Array = field(default_factory=lambda: np.empty(0))
    """[K]"""
    unknown_s: tuple[tuple[float, float], ...] = ()
    """Stretches of its stamps in which its rotations were unlike the camera's, or its clock ran at
    another rate."""
    unlike: bool = False
    """True if it turned unlike the camera in at least one piece."""
    drifts: bool = False
    """True if its clock ran at another rate than the pictures' in at least one piece."""
    reason: str = ""
    """Why no offset was found; empty where one was."""

    @property
    def known(self) -> bool:
        """True if an offset was found anywhere."""
        return len(self.at_s) > 0

    @property
    def right(self) -> bool:
        """True if samples may stay where they are."""
        within = np.abs(self.offset_s) <= np.maximum(NEGLIGIBLE_S, 2.0 * self.sigma_s)
        return bool(within.all()) and not self.unknown_s

    @property
    def sigma(self) -> tuple[float, float]:
        """1 sigma of what is left of the offset, s, and of its growth, s/s: of what was not
        corrected all of it, and what the rotations leave open."""
        if not self.known:
            return LATENCY_S, DRIFT_SIGMA
        left_s, left_sigma_s = _mean_of(self.offset_s, self.sigma_s)
        drift, drift_sigma = _mean_of(self.drift, self.drift_sigma)
        left_s = left_s if self.right else 0.0
        sigma_s = float(np.linalg.norm([LATENCY_S, left_s, left_sigma_s]))
        return sigma_s, float(np.hypot(drift, drift_sigma))

    @property
    def latest_s(self) -> float:
        """The newest offset; 0 where none is known."""
        return float(self.offset_s[-1]) if self.known else 0.0

    def correct(self, series: Series) -> Series:
        """Samples on the pictures' clock, without those whose time is not known."""
        if not self.known or self.right or len(series) == 0:
            return series
        usable = np.ones(len(series), dtype=bool)
        for first_s, last_s in self.unknown_s:
            usable &= (series.t_s < first_s) | (series.t_s > last_s)
        t_s = series.t_s + np.interp(series.t_s, self.at_s, self.offset_s)
        usable &= np.concatenate([[True], np.diff(np.maximum.accumulate(t_s)) > 0.0])
        return Series(series.source, t_s[usable], series.values[usable])

    def in_words(self) -> str:
        """What was done about it, for the user; empty where nothing was."""
        if self.drifts and not self.known:
            return f"'{self.device}' is left out: {self.reason}"
        if not self.known or self.right:
            return ""
        late = f"{abs(self.latest_s):.2f} s {'late' if self.latest_s < 0.0 else 'early'}"
        done = "parts are left out" if self.unknown_s else "corrected"
        return f"'{self.device}' is {late} by its rotations: {done}"


@dataclass(frozen=True)
class DeviceClocks:
    """Clocks of all devices of a dive."""

    own: Mapping[str, DeviceClockEstimate]
    """By device, of those with a gyro or an attitude."""

    @staticmethod
    def of(
        telemetry: Telemetry,
        path: CameraPath,
        R_cb: Array | None,  # [3, 3] body to camera
    ) -> DeviceClocks:
        """The clocks as ``path`` and the devices' rotations show them."""
        rates, attitudes = telemetry.of(AngularRate), telemetry.of(Attitude)
        devices = sorted({device_of(series.source) for series in (*rates, *attitudes)})
        pieces = _pieces(path)
        own = {}
        for device in devices:
            found = best_turns(
                [series for series in rates if device_of(series.source) == device],
                [series for series in attitudes if device_of(series.source) == device],
            )
            if found is not None:
                own[device] = _clock(device, found[1], pieces, R_cb)
        return DeviceClocks(own)

    @property
    def known(self) -> bool:
        """True if at least one device shows what its clock is."""
        return self.reference.known

    @property
    def reference(self) -> DeviceClockEstimate:
        """Clock of the device that shows most, for those that show nothing."""
        nothing = DeviceClockEstimate("", reason="no device has a gyro or an attitude")
        return max(self.own.values(), key=lambda clock: len(clock.at_s), default=nothing)

    def clock_of(self, source: str) -> DeviceClockEstimate:
        """The clock of a source's device: its own, or else the reference's."""
        return self.own.get(device_of(source), self.reference)

    def leave_open(self, problem: TelemetryProblem) -> bool:
        """True if the scale comes from a device whose own rotations do not show its clock, and
        from nothing that shows itself whether it fits the path."""
        if any(factor.kind in SHOWN_BY_THE_PATH for factor in problem.factors):
            return False
        return any(
            factor.kind in MEASURED_IN_TIME and not self._is_shown(factor.source)
            for factor in problem.factors
        )

    def _is_shown(self, source: str) -> bool:
        clock = self.own.get(device_of(source))
        return clock is not None and clock.known

    def sigma_of(self, problem: TelemetryProblem) -> Array:
        """[2] 1 sigma of ``CLOCK``: of the worst clock among those of what moved in time."""
        moved = [factor.source for factor in problem.factors if factor.kind in MOVED_IN_TIME]
        sigmas = [self.clock_of(source).sigma for source in moved]
        return np.asarray(np.max([(LATENCY_S, DRIFT_SIGMA), *sigmas], axis=0))

    @property
    def why_open(self) -> str:
        """Why rotations do not show whether all clocks agree."""
        clock = self.reference
        return "some devices have no gyro or attitude" if clock.known else clock.reason

    def with_clocks(self, frame: WorldFrame) -> WorldFrame:
        """The frame with what was found of the clocks."""
        clock = self.reference
        said = "; ".join(filter(None, (frame.scale_source, clock.in_words())))
        moved_s = 0.0 if clock.right else clock.latest_s
        return replace(frame, scale_source=said, clock_offset_s=moved_s)

    def left_out(self, telemetry: Telemetry) -> dict[tuple[str, str], SourceReport]:
        """Sources whose times are not known at all, by name and kind: attitudes of devices that
        turned otherwise than the camera, and all that a clock of another rate has stamped."""
        found = {}
        for kind in (kind for kind in USED if kind not in SHOWN_BY_THE_PATH):
            for series in telemetry.of(KINDS[kind]):
                clock = self.clock_of(series.source)
                if not clock.known and (clock.drifts or (clock.unlike and kind == "attitude")):
                    found[series.source, kind] = SourceReport(
                        series.source, kind, rejected=len(series), reason=clock.reason
                    )
        return found

    def correct(self, telemetry: Telemetry) -> Telemetry:
        """All samples on the pictures' clock; the same object where nothing is to be done."""
        if all(not clock.known or clock.right for clock in self.own.values()):
            return telemetry
        return telemetry.retime(lambda series: self.clock_of(series.source).correct(series))


def _pieces(path: CameraPath) -> list[Turns]:
    """The camera's turns in pieces, evenly along the path."""
    if len(path) < 2:
        return []
    first_s, last_s = float(path.t_s[0]), float(path.t_s[-1])
    count = int(np.clip((last_s - first_s) // PIECE_S, 1, MOST_PIECES))
    length_s = max(PIECE_S, (last_s - first_s) / count) if count < MOST_PIECES else PIECE_S
    found = []
    for begin_s in np.linspace(first_s, max(last_s - length_s, first_s), count):
        inside = (path.t_s >= begin_s - 1e-6) & (path.t_s <= begin_s + length_s + 1e-6)
        found.append(Turns.of_orientations(path.t_s[inside], path.R_mc[inside]))
    return [piece for piece in found if piece.covered_s >= SHORTEST_OVERLAP_S]


def _clock(
    device: str,
    body: Turns,
    pieces: Sequence[Turns],
    R_cb: Array | None,  # [3, 3]
) -> DeviceClockEstimate:
    """A device's clock from its turns and the camera's."""
    found: list[tuple[float, TimeOffset]] = []
    unlike: list[tuple[float, float]] = []
    drifting: list[tuple[float, float]] = []
    reason, drift_reason, expected_s = "the camera's path is too short", "", 0.0
    for piece in pieces:
        first_s, last_s = float(piece.start_s[0]), float(piece.end_s[-1])
        near = (body.end_s >= first_s - REACH_S) & (body.start_s <= last_s + REACH_S)
        part = Turns(body.start_s[near], body.end_s[near], body.angle_rad[near])
        try:
            offset = _offset(piece, part, R_cb, expected_s)
        except UnlikeError as error:
            reason = str(error)
            if _evident(piece, part, expected_s):
                unlike.append((first_s - expected_s, last_s - expected_s))
        except NotSynchronisedError as error:
            reason = str(error)
        else:
            if _drifts(offset, last_s - first_s):
                drift_reason = _drift_in_words(offset)
                drifting.append((first_s - offset.offset_s, last_s - offset.offset_s))
                continue
            expected_s = offset.offset_s
            found.append((0.5 * (first_s + last_s) - expected_s, offset))
    if not found:
        return DeviceClockEstimate(
            device, unlike=bool(unlike), drifts=bool(drifting), reason=drift_reason or reason
        )
    found.sort(key=lambda each: each[0])
    at_s = np.array([at for at, _ in found])
    offset_s = np.array([offset.offset_s for _, offset in found])
    sigma_s = np.array([offset.sigma_s for _, offset in found])
    drift = np.array([offset.drift for _, offset in found])
    drift_sigma = np.array([offset.drift_sigma for _, offset in found])
    unknown_s = _unknown(at_s, offset_s, [*unlike, *drifting])
    return DeviceClockEstimate(
        device, at_s, offset_s, sigma_s, drift, drift_sigma, unknown_s,
        bool(unlike), bool(drifting),
    )  # fmt: skip


def _mean_of(
    values: Array,  # [K]
    sigma: Array,  # [K]
) -> tuple[float, float]:
    """The weighted mean and its 1 sigma."""
    weight = sigma**-2.0
    return float(weight @ values / weight.sum()), float(weight.sum() ** -0.5)


def _drifts(offset: TimeOffset, length_s: float) -> bool:
    """True if no offset is that of a whole piece."""
    changed_s = abs(offset.drift) * length_s
    evident = abs(offset.drift) > EVIDENT_DRIFT * offset.drift_sigma
    return evident and changed_s > LARGEST_STEP_S


def _drift_in_words(offset: TimeOffset) -> str:
    fast = "slower" if offset.drift > 0.0 else "faster"
    return f"its clock runs {100.0 * abs(offset.drift):.0f} % {fast} than that of the pictures"


def _offset(
    camera: Turns,
    body: Turns,
    R_cb: Array | None,  # [3, 3]
    expected_s: float,
) -> TimeOffset:
    """The offset in one piece; also where the camera is mounted otherwise than it is stated.

    Raises:
        NotSynchronisedError: as :func:`estimate_time_offset`.
    """
    try:
        return estimate_time_offset(camera, body, R_cb, expected_s, any_drift=True)
    except UnlikeError:
        if R_cb is None:
            raise
        return estimate_time_offset(camera, body, None, expected_s, any_drift=True)


def _unknown(
    at_s: Array,  # [K]
    offset_s: Array,  # [K]
    unlike: Sequence[tuple[float, float]],
) -> tuple[tuple[float, float], ...]:
    """Stretches between pieces that disagree, and those about pieces that are unlike."""
    found = [
        (float(at_s[k]), float(at_s[k + 1]))
        for k in np.flatnonzero(np.abs(np.diff(offset_s)) > LARGEST_STEP_S)
    ]
    for first_s, last_s in unlike:
        before, after = at_s[at_s <= first_s], at_s[at_s >= last_s]
        begin = float(before[-1]) if len(before) else -np.inf
        found.append((begin, float(after[0]) if len(after) else np.inf))
    return tuple(found)


def _evident(camera: Turns, body: Turns, expected_s: float) -> bool:
    """True if both turned, and the body was measured, at the time at which it was expected."""
    start_s, end_s = camera.start_s - expected_s, camera.end_s - expected_s
    angle, covered = body.within(start_s, end_s)
    if float(covered.mean()) < LEAST_MEASURED:
        return False
    return bool(min(_rms(camera), _rms(Turns(start_s, end_s, angle))) >= LEAST_EVIDENT_RAD_S)


def _rms(turns: Turns) -> float:
    """Of the rates about their mean, rad/s."""
    if len(turns.start_s) == 0:
        return 0.0
    rates = turns.angle_rad / (turns.end_s - turns.start_s)[:, None]
    return float(np.sqrt(((rates - rates.mean(axis=0)) ** 2).sum(axis=1).mean()))
