"""How something turned, interval by interval: of a camera by its poses, of a vehicle by its
instruments.

A turn is the rotation over one interval of time, as a vector about its own axes; divided by the
length of the interval it is the mean rate. Poses give nothing but such means, so rates are
integrated over the same intervals before the two are compared.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import nearest_rotation
from aquaflow.telemetry.telemetry import Series
from aquaflow.types import AngularRate, Attitude, TelemetrySample, values_of

Array = npt.NDArray[np.float64]

LONGEST_INTERVAL_S = 1.5
"""Over a longer one an ROV may turn to and fro: pictures at 1 per second still count, a loss of
tracking or of the link does not."""
FEW_RATES_HZ = 5.0
"""A gyro that is logged more slowly misses the sway of a small ROV (2 s and longer) between two of
its samples; attitudes miss nothing."""
NO_SERIES = Series("", np.empty(0), np.empty((0, 4)))


@dataclass(frozen=True)
class Turns:
    """Rotations over intervals of time, in order; gaps between intervals are allowed."""

    start_s: Array
    """[K]"""
    end_s: Array
    """[K]"""
    angle_rad: Array
    """[K, 3] rotation vector over the interval, in the axes of what turns."""

    @staticmethod
    def of_orientations(
        t_s: Array,  # [N]
        R_wb: Array,  # [N, 3, 3] of what turns to a frame at rest
    ) -> Turns:
        """Turns between orientations; times that do not rise, and long intervals, are left out."""
        relative = np.swapaxes(R_wb[:-1], 1, 2) @ R_wb[1:]
        angle = Rotation.from_matrix(relative).as_rotvec() if len(relative) else np.empty((0, 3))
        return Turns(t_s[:-1], t_s[1:], angle)._usable()

    @staticmethod
    def of_rates(
        t_s: Array,  # [M]
        rate_rad_s: Array,  # [M, 3]
    ) -> Turns:
        """Turns between samples of a gyro, by the trapezoidal rule."""
        angle = np.diff(t_s)[:, None] * 0.5 * (rate_rad_s[:-1] + rate_rad_s[1:])
        return Turns(t_s[:-1], t_s[1:], angle)._usable()

    @staticmethod
    def join(parts: Sequence[Turns]) -> Turns:
        """The turns of several sub-maps, of which none overlaps another, as one."""
        parts = sorted((part for part in parts if len(part.start_s)), key=lambda p: p.start_s[0])
        if not parts:
            return Turns(np.empty(0), np.empty(0), np.empty((0, 3)))
        return Turns(
            np.concatenate([part.start_s for part in parts]),
            np.concatenate([part.end_s for part in parts]),
            np.concatenate([part.angle_rad for part in parts]),
        )

    def _usable(self) -> Turns:
        length = self.end_s - self.start_s
        finite = np.isfinite(self.angle_rad).all(axis=1) & np.isfinite(length)
        keep = finite & (length > 0.0) & (length <= LONGEST_INTERVAL_S)
        return Turns(self.start_s[keep], self.end_s[keep], self.angle_rad[keep])

    @property
    def covered_s(self) -> float:
        """Sum of the intervals."""
        return float((self.end_s - self.start_s).sum())

    def within(
        self,
        start_s: Array,  # [N]
        end_s: Array,  # [N]
    ) -> tuple[Array, Array]:
        """Angle [N, 3] turned over other intervals, and the share [N] of each that is covered."""
        found = self._until(end_s) - self._until(start_s)
        return found[:, :3], found[:, 3] / (end_s - start_s)

    @cached_property
    def _totals(self) -> tuple[Array, Array]:
        """Ends of the intervals [2 K], s, and what was turned, rad, and covered, s, until then
        [2 K, 4]. Kept, for a fit of a clock asks a hundred times."""
        edges_s = np.column_stack([self.start_s, self.end_s]).ravel()
        rises = np.zeros((len(edges_s), 4))
        rises[1::2, :3] = self.angle_rad
        rises[1::2, 3] = self.end_s - self.start_s
        return edges_s, np.cumsum(rises, axis=0)

    def _until(
        self,
        t_s: Array,  # [N]
    ) -> Array:
        """[N, 4] turned, rad, and covered, s, until other moments."""
        edges_s, totals = self._totals
        if not len(edges_s):
            return np.zeros((len(t_s), 4))
        before = np.searchsorted(edges_s, t_s, side="right") - 1
        before = np.clip(before, 0, len(edges_s) - 2)
        length_s = edges_s[before + 1] - edges_s[before]
        share = np.clip((t_s - edges_s[before]) / length_s, 0.0, 1.0)[:, None]
        return np.asarray(totals[before] + share * (totals[before + 1] - totals[before]))


def smoothing(
    turns: Turns,
    at_s: Array,  # [G]
    sigma_s: float,
) -> tuple[csr_array, Array]:
    """Operator [G, K] from angles to rates smoothed by a Gaussian, and its coverage [G], 0 to 1."""
    reach_s = 3.0 * sigma_s
    middle = 0.5 * (turns.start_s + turns.end_s)
    first = np.searchsorted(middle, at_s - reach_s)
    count = np.searchsorted(middle, at_s + reach_s) - first
    row = np.repeat(np.arange(len(at_s)), count)
    column = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + first[row]
    weight = np.exp(-0.5 * ((middle[column] - at_s[row]) / sigma_s) ** 2)
    length = (turns.end_s - turns.start_s)[column]
    total = np.bincount(row, weight * length, len(at_s))
    operator = csr_array((weight / total[row], (row, column)), (len(at_s), len(middle)))
    return operator, total / (np.sqrt(2.0 * np.pi) * sigma_s)


def turns_of_telemetry(samples: Iterable[TelemetrySample]) -> tuple[str, Turns] | None:
    """The best source of rotations among ``samples``, with its name; None where there is none."""
    rates: dict[str, list[AngularRate]] = {}
    attitudes: dict[str, list[Attitude]] = {}
    for sample in samples:
        if isinstance(sample, AngularRate):
            rates.setdefault(sample.source, []).append(sample)
        elif isinstance(sample, Attitude):
            attitudes.setdefault(sample.source, []).append(sample)
    return best_turns(
        [_in_order(source, found) for source, found in rates.items()],
        [_in_order(source, found) for source, found in attitudes.items()],
    )


def best_turns(rates: Sequence[Series], attitudes: Sequence[Series]) -> tuple[str, Turns] | None:
    """The best source of rotations, with its name; None where there is none.

    A gyro counts before attitudes, unless it was logged more slowly than they were, or too slowly
    to be integrated; of equals, the source with more samples.
    """
    gyro = max(rates, key=len, default=NO_SERIES)
    ahrs = max(attitudes, key=len, default=NO_SERIES)
    if len(gyro) >= len(ahrs) or _frequency_hz(gyro) >= FEW_RATES_HZ:
        return (gyro.source, Turns.of_rates(gyro.t_s, gyro.values)) if len(gyro) >= 2 else None
    R_nb = Rotation.from_quat(np.roll(ahrs.values, -1, axis=1)).as_matrix()
    return ahrs.source, Turns.of_orientations(ahrs.t_s, R_nb)


def _frequency_hz(series: Series) -> float:
    if len(series) < 2:
        return 0.0
    return float(1.0 / max(np.median(np.diff(series.t_s)), 1e-9))


def _in_order(source: str, samples: Sequence[AngularRate | Attitude]) -> Series:
    """The samples by time."""
    times = np.array([sample.t_ns for sample in samples]) * 1e-9
    order = np.argsort(times, kind="stable")
    values = np.asarray([values_of(sample) for sample in samples], dtype=float)
    return Series(source, times[order], values[order])


# --------------------------------------------------------------------------------------------------
# Every offset between two series of turns at once: how much of one the other explains.
#
# For each offset the rotation between the two sets of axes is the best one for that offset (Wahba's
# problem by singular values), and constant rates, such as the bias of a gyro, are taken out of
# both. All sums over the overlap are correlations, so the FFT gives them for all offsets together.

CELL_S = 0.05
"""Step of the search: a third of the smoothing, so that no peak falls between two steps."""
COVERED = 0.8
"""Share of a cell, and of the smoothing about it, that must have been measured."""
SHORTEST_OVERLAP_S = 5.0
"""Less than one cycle of an ROV's sway (4 to 9 s) matches almost anywhere in a log."""
LEAST_OVERLAP = 0.2
"""Of the shorter of the two: a single turn at the end of a dive looks like one at its beginning."""
PEAK_PROMINENCE = 0.01
"""Of the highest peak: what stands out less is noise on the way up to a peak."""
RIVAL_SHARE = 0.5
"""Of what the best offset explains: an offset that explains less is no rival. Mostly it is one at
which half of the log, or more, would have been recorded without the video."""
MOST_PEAKS = 8
"""Highest first; the later ones only repeat what the first rivals show."""


@dataclass(frozen=True)
class RateSeries:
    """Smoothed rates on a uniform grid of times."""

    start_s: float
    """Beginning of the first cell."""
    cell_s: float
    rate_rad_s: Array
    """[L, 3]; zero where nothing was measured."""
    measured: Array
    """[L] 1 or 0."""

    @staticmethod
    def of(turns: Turns, sigma_s: float, cell_s: float = CELL_S) -> RateSeries:
        """Mean rates over the cells, smoothed by a Gaussian."""
        count = int(np.ceil((turns.end_s[-1] - turns.start_s[0]) / cell_s))
        start_s = turns.start_s[0] + cell_s * np.arange(count)
        angle, covered = turns.within(start_s, start_s + cell_s)
        known = (covered >= COVERED).astype(float)
        rate = angle / (cell_s * np.maximum(covered, COVERED))[:, None] * known[:, None]
        width = sigma_s / cell_s
        smooth = gaussian_filter1d(rate, width, axis=0, mode="constant")
        weight = gaussian_filter1d(known, width, mode="constant")
        measured = (weight >= COVERED).astype(float)
        rate = smooth / np.maximum(weight, COVERED)[:, None] * measured[:, None]
        return RateSeries(float(start_s[0]), cell_s, rate, measured)

    def turns(self) -> Turns:
        """The smoothed rates as turns over the cells."""
        cells = np.flatnonzero(self.measured)
        edges_s: Array = self.start_s + self.cell_s * np.arange(len(self.measured) + 1.0)
        angle = self.cell_s * self.rate_rad_s[cells]
        return Turns(edges_s[cells], edges_s[cells + 1], angle)


@dataclass(frozen=True)
class OffsetPeak:
    """An offset at which the telemetry explains the camera's turns better than just beside it."""

    offset_s: float
    """Telemetry time + offset = video time."""
    R_cb: Array
    """[3, 3] body to camera."""
    explained: float
    """Share of the camera's turning, all of it, that the telemetry predicts; at most 1."""


Searched = tuple[Array, Array, Array]
"""Share explained [L] (-inf where the overlap is short), H [L, 3, 3], offsets [L] in s."""


def peaks(
    searched: Searched,  # [L], [L, 3, 3], [L]
    R_cb: Array | None,  # [3, 3]
) -> list[OffsetPeak]:
    """The best offset and its rivals, best first; empty where none explains anything."""
    from scipy.signal import find_peaks  # half a second, for the dives that have logs

    explained, H, offsets_s = searched
    if not len(explained) or not np.isfinite(explained).any() or explained.max() <= 0.0:
        return []
    floor = np.concatenate([[0.0], np.maximum(explained, 0.0), [0.0]])
    found, _ = find_peaks(floor, prominence=PEAK_PROMINENCE * explained.max())
    found = found[floor[found] >= RIVAL_SHARE * explained.max()]
    found = found[np.argsort(-floor[found], kind="stable")][:MOST_PEAKS] - 1
    rotation = (
        nearest_rotation(H[found]) if R_cb is None else np.broadcast_to(R_cb, (len(found), 3, 3))
    )
    return [
        OffsetPeak(float(offsets_s[i]), rotation[n], float(explained[i]))
        for n, i in enumerate(found)
    ]


def peak_at(
    searched: Searched,  # [L], [L, 3, 3], [L]
    R_cb: Array | None,  # [3, 3]
    offset_s: float,
) -> OffsetPeak:
    """One offset, however much it explains."""
    explained, H, offsets_s = searched
    near = int(np.argmin(np.abs(offsets_s - offset_s)))
    R = nearest_rotation(H[near]) if R_cb is None else R_cb
    return OffsetPeak(offset_s, R, float(explained[near]))


def explained_at_all_offsets(
    camera: RateSeries,
    body: RateSeries,
    R_cb: Array | None,  # [3, 3]
) -> Searched:
    """How well each offset explains the camera's turns by the body's."""
    from scipy.signal import correlate

    v, g, mv, mg = camera.rate_rad_s, body.rate_rad_s, camera.measured, body.measured

    def sums(a: Array, b: Array) -> Array:  # [Nv] and [Ng]
        return np.asarray(correlate(a, b, mode="full", method="fft"))

    overlap = np.round(sums(mv, mg))
    n = np.maximum(overlap, 1.0)
    of_v = np.stack([sums(v[:, i], mg) for i in range(3)], axis=-1)
    of_g = np.stack([sums(mv, g[:, i]) for i in range(3)], axis=-1)
    H = np.stack([[sums(v[:, i], g[:, j]) for j in range(3)] for i in range(3)])
    H = np.moveaxis(H, 2, 0) - of_v[:, :, None] * of_g[:, None, :] / n[:, None, None]
    energy = sums(mv, (g**2).sum(axis=1)) - (of_g**2).sum(axis=1) / n
    centred = v - (v.sum(axis=0) / max(mv.sum(), 1.0)) * mv[:, None]
    total = float((centred**2).sum())
    least = max(SHORTEST_OVERLAP_S / CELL_S, LEAST_OVERLAP * min(mv.sum(), mg.sum()))
    feasible = (overlap >= least) & (total > 0.0)
    explained = np.full(len(overlap), -np.inf)
    if R_cb is None:
        match = _largest_trace(H[feasible])
    else:
        match = np.einsum("ij,nij->n", R_cb, H[feasible])
    explained[feasible] = (2.0 * match - energy[feasible]) / max(total, 1e-300)
    shift = np.arange(len(overlap)) - (len(g) - 1)
    offsets_s: Array = camera.start_s - body.start_s + CELL_S * shift.astype(float)
    return explained, np.asarray(H), offsets_s


def _largest_trace(H: Array) -> Array:  # [N, 3, 3]
    """[N] largest trace of R^T H over all rotations R."""
    singular = np.linalg.svd(H, compute_uv=False)
    return np.asarray(singular[:, 0] + singular[:, 1] + np.sign(np.linalg.det(H)) * singular[:, 2])
