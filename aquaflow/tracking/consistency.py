"""A monitor of consistency: do the depths of the keyframe in use fit its past, its neighbours, and
the matches?

A frame's pose takes its scale from its keyframe's pointmap and hands its errors back with its
depths; a new keyframe inherits both. A wrong scale fits everything that follows, and every frame
has a pose. What it does not fit are depths from before: a few points of every keyframe, taken when
it was first left, are kept (:class:`Neighbours`) and looked up in the pointmap in use. Depths whose
errors are no common scale are seen by the matches that no pose explains.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from aquaflow.base.errors import times
from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.two_view import pose_candidates
from aquaflow.keyframes import Keyframe, Pointmap
from aquaflow.optimise.robust import sigma_of
from aquaflow.prior.contract import PairGeometry
from aquaflow.tracking.graph.table import Snapshot
from aquaflow.tracking.loops import Neighbour, Neighbours, sketch
from aquaflow.tracking.pose.matcher import Matched

REMEMBERED = 20
"""Findings that are listed."""
SHOWN_FRAMES = 50
"""Frames with a pose for which a finding stays in the state of the service: 5 s at 10 a second."""
USUAL_FRAMES = 600
"""Frames whose median is the usual share of inliers: a minute at 10 a second."""


SOON = 3
"""Frames between two checks where few matches fit."""
MOST_WITNESSES = 5
"""Keyframes around that a check asks, at most."""
MIN_SIGMAS = 5.0
"""A difference of scale beyond its bound counts from so many sigmas of the median over the points
that both keyframes show."""
MIN_INLIER_SHARE = 0.5
"""Share of inliers of the matches below which the keyframe's depths do not fit; measured on
calibrated clips: 0.61 to 0.97 in every frame."""
RIGID_SHARE = 0.8
"""Share of the matches that one motion explains from which those that do not fit the depths are no
snow in front of the scene."""
USUAL_SHARE = 0.65
"""``MIN_INLIER_SHARE`` is no more than this share of the dive's median: a wrong calibration lowers
that (to 0.53)."""


class Cause(str, Enum):
    """What does not fit."""

    DEPTHS = "depths"
    """The keyframe's own depths have changed their scale since it was first left."""
    POSE = "scale"
    """Its depths, scaled by its pose, do not fit those of keyframes around it."""
    MATCHES = "matches"
    """Too few matches fit its depths, wherever the frame is taken to be."""


@dataclass(frozen=True)
class InconsistentKeyframe:
    """A keyframe that is not consistent."""

    frame: int
    """Index of the frame at which it was noticed."""
    keyframe: int
    cause: Cause
    ratio: float
    """Of its scale to the one that it should have; of ``MATCHES`` the share of inliers."""

    def __str__(self) -> str:
        if self.cause is Cause.MATCHES:
            return f"only {100.0 * self.ratio:.0f} % of the matches fit keyframe {self.keyframe}"
        off = 100.0 * (self.ratio - 1.0)
        of = "the one it had" if self.cause is Cause.DEPTHS else "that of the keyframes around it"
        return f"scale of keyframe {self.keyframe} is {off:+.0f} % off {of}"


@dataclass
class ConsistencyCounts:
    """What the monitor did in a dive; written by tracking, read by anyone."""

    checks: int = 0
    found: int = 0
    rescaled: int = 0
    """Keyframes whose depths were brought back to their scale."""
    refused: int = 0
    """Keyframes whose depths are triangulated anew."""
    relocalised: int = 0
    """Times that tracking went on at an earlier keyframe."""
    unrepaired: int = 0
    """Findings of which no earlier keyframe could be matched."""
    findings: tuple[InconsistentKeyframe, ...] = ()
    """The latest."""

    def add(self, finding: InconsistentKeyframe) -> None:
        """A finding that was confirmed."""
        self.found += 1
        self.findings = (*self.findings, finding)[-REMEMBERED:]

    def notes(self) -> list[str]:
        """A sentence for the user if there were findings."""
        if not self.found:
            return []
        last = self.findings[-1]
        return [
            f"tracking was inconsistent {times(self.found)}, last at frame {last.frame} ({last}); "
            f"{self.found - self.unrepaired} repaired"
        ]

    def to_json(self) -> dict[str, object]:
        """The counts for /health and metrics.json."""
        return {
            "checks": self.checks,
            "found": self.found,
            "rescaled": self.rescaled,
            "triangulated_anew": self.refused,
            "relocalised": self.relocalised,
            "unrepaired": self.unrepaired,
            "findings": [
                {
                    "frame": each.frame,
                    "keyframe": each.keyframe,
                    "cause": each.cause.value,
                    "ratio": round(each.ratio, 4),
                }
                for each in self.findings
            ],
        }


class ConsistencyMonitor:
    """Checks the keyframe in use now and then; a finding counts when the next frame confirms it."""

    def __init__(self, neighbours: Neighbours, config: TrackingConfig) -> None:
        self._neighbours, self._config = neighbours, config
        self._own: tuple[Keyframe, Array] | None = None
        self._inliers: deque[float] = deque(maxlen=USUAL_FRAMES)
        self._since, self._suspected = 0, False
        self._frames_since = SHOWN_FRAMES
        self.counts = ConsistencyCounts()

    @property
    def trouble(self) -> InconsistentKeyframe | None:
        """The last finding, for some seconds."""
        recent = self._frames_since < SHOWN_FRAMES and self.counts.findings
        return self.counts.findings[-1] if recent else None

    def after(
        self, keyframe: Keyframe, frame: int, solved: Matched | None, camera: CameraModel
    ) -> InconsistentKeyframe | None:
        """To be called after every frame with a pose; a finding that two checks in a row had.

        ``solved``: the frame at the keyframe, or None if it has become the keyframe itself.
        """
        self._since += 1
        self._frames_since += 1
        few = False
        if solved is not None:
            self._inliers.append(solved.estimate.inlier_share)
            few = solved.estimate.inlier_share < MIN_INLIER_SHARE
        if self._own is None or self._own[0] is not keyframe:
            known = self._neighbours.points(keyframe)
            self._own = (keyframe, sketch(keyframe, self._config) if known is None else known)
            self._suspected = False
        monitor = self._config.monitor
        due = self._suspected or self._since >= (SOON if few else monitor.every)
        if not (monitor.enabled and due):
            return None
        self._since = 0
        self.counts.checks += 1
        finding = self._check(keyframe, frame)
        if finding is None and solved is not None and self._misfits(keyframe, solved, camera):
            share = solved.estimate.inlier_share
            finding = InconsistentKeyframe(frame, keyframe.number, Cause.MATCHES, share)
        confirmed = self._suspected and finding is not None
        self._suspected = finding is not None and not confirmed
        if finding is None or not confirmed:
            return None
        self._frames_since = 0
        self.counts.add(finding)
        return finding

    def _check(self, keyframe: Keyframe, frame: int) -> InconsistentKeyframe | None:
        monitor, number = self._config.monitor, keyframe.number
        own = self._change(keyframe)
        if own is not None and _is_off(own, monitor.max_change, MIN_SIGMAS):
            return InconsistentKeyframe(frame, number, Cause.DEPTHS, float(np.exp(own.log)))
        gap = self._gap(keyframe)
        if gap is not None:
            return InconsistentKeyframe(frame, number, Cause.POSE, float(np.exp(gap.log)))
        return None

    def _misfits(self, keyframe: Keyframe, solved: Matched, camera: CameraModel) -> bool:
        """True if the scene is in plain view, but where the keyframe's depths do not put it."""
        if solved.estimate.inlier_share >= self.least_inliers:
            return False
        rigid = rigid_share(solved.pair, keyframe.pointmap.camera, camera)
        return rigid >= RIGID_SHARE

    @property
    def least_inliers(self) -> float:
        """Share of inliers below which the depths do not fit the matches."""
        usual = float(np.median(self._inliers)) if self._inliers else 0.0
        return min(MIN_INLIER_SHARE, USUAL_SHARE * usual)

    def _change(self, keyframe: Keyframe) -> DepthRatio | None:
        """Of the keyframe's depths since they were first known."""
        assert self._own is not None
        known_sigma = self._config.known_sigma
        return depth_ratio(self._own[1], Sim3.identity(), keyframe.pointmap, known_sigma)

    def _gap(self, keyframe: Keyframe) -> DepthRatio | None:
        """Between the keyframe's scale and that of most around it, if it is too large.

        Where most of them are off, and to the same side, it is not they who are wrong.
        """
        monitor = self._config.monitor
        ratios = sorted((ratio for _, ratio in self.witnesses(keyframe)), key=lambda r: r.log)
        off = [r for r in ratios if _is_off(r, monitor.max_gap, MIN_SIGMAS)]
        if 2 * len(off) <= len(ratios):
            return None
        middle = ratios[len(ratios) // 2]
        return middle if middle in off else None

    def witnesses(self, keyframe: Keyframe) -> list[tuple[Neighbour, DepthRatio]]:
        """The keyframes around, the most alike first, and what they say of its depths."""
        camera = keyframe.pointmap.camera
        around = self._neighbours.around(keyframe.T_wc, camera, keyframe.sub_map, keyframe)
        found = []
        for neighbour in around[:MOST_WITNESSES]:
            points = self._neighbours.points(neighbour.keyframe)
            assert points is not None
            ratio = depth_ratio(points, neighbour.T_fk, keyframe.pointmap, self._config.known_sigma)
            if ratio is not None:
                found.append((neighbour, ratio))
        return found


def _is_off(ratio: DepthRatio, most: float, sigmas: float) -> bool:
    return abs(ratio.log) > max(most, sigmas * ratio.sigma)


# --------------------------------------------------------------------------------------------------
# Do two pointmaps agree about how far the scene is? Points of one, looked up in the other.

Array = npt.NDArray[np.float64]

MIN_POINTS = 16
"""Points in common below which nothing is said: a quarter of a sketch."""
MEDIAN = 1.2533
"""Standard deviation of a median over that of a mean."""


@dataclass(frozen=True)
class DepthRatio:
    """How much further a pointmap has the scene than other points say."""

    log: float
    """Median of log (depth in the pointmap / depth of the points)."""
    sigma: float
    """Standard deviation of that median, from the spread."""
    points: int


def depth_ratio(
    points: Array,  # [M, 3] in any frame
    T_kp: Sim3,
    pointmap: Pointmap,
    known_sigma: float,
) -> DepthRatio | None:
    """Depths of ``pointmap`` against those of ``points``, which ``T_kp`` takes to its keyframe;
    None where it shows too few of them."""
    X = T_kp.apply(points)
    X = X[X[:, 2] > 1e-6]
    camera = pointmap.camera
    pixels = camera.project(X)
    inside = ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(-1)
    X, (u, v) = X[inside], np.floor(pixels[inside]).astype(np.intp).T
    rho, variance = pointmap.rho[v, u], pointmap.variance[v, u]
    known = (rho > 1e-6) & (variance < (known_sigma * rho) ** 2)
    if known.sum() < MIN_POINTS:
        return None
    logs = -np.log(X[known, 2] * rho[known])
    middle = float(np.median(logs))
    spread = sigma_of(logs - middle)
    count = len(logs)
    return DepthRatio(middle, MEDIAN * spread / float(np.sqrt(count)), count)


# --------------------------------------------------------------------------------------------------
# Are the matches of a frame those of one rigid scene, whatever the keyframe's depths say? What
# floats in front of the scene moves as it likes; wrong depths leave the matches as they are.

SAMPLED = 400
"""Matches that the two-view pose is estimated from: some 5 ms."""


def rigid_share(
    pair: PairGeometry,
    camera_k: CameraModel,
    camera: CameraModel,
) -> float:
    """Share of the valid matches that one motion of the camera explains; 0 of too few."""
    rows, columns = np.nonzero(pair.valid)
    step = max(1, -(-len(rows) // SAMPLED))
    rows, columns = rows[::step], columns[::step]
    pixels_k = np.stack([columns + 0.5, rows + 0.5], -1)
    pixels = pair.matches[rows, columns].astype(np.float64)
    candidates = pose_candidates(pixels_k, pixels, camera_k, camera)
    return candidates[0].support if candidates else 0.0


# --------------------------------------------------------------------------------------------------
# Scale that drifts slowly takes all keyframes around with it, so that nothing above sees it. Loops
# and telemetry do: what they changed of the links' scales is the drift.

TOLD_DRIFT = 0.03
"""Relative, from which a drift is told to the user."""


@dataclass(frozen=True)
class ScaleDrift:
    """The largest drift of scale along the links of a graph, as its optimisation corrected it."""

    first: int
    """Frame between whose keyframe and that of ``last`` it grew."""
    last: int
    ratio: float
    """Of the scale as tracked to the corrected one, at ``last``, over the same at ``first``."""

    def notes(self) -> list[str]:
        """A sentence for the user if the drift is worth one."""
        if abs(np.log(self.ratio)) < TOLD_DRIFT:
            return []
        return [
            f"the scale of tracking drifted by {100.0 * (self.ratio - 1.0):+.0f} % between frames "
            f"{self.first} and {self.last}; loops or telemetry showed it, and it was corrected"
        ]

    def to_json(self) -> dict[str, float | int]:
        """The drift as metrics.json has it."""
        return {"first": self.first, "last": self.last, "ratio": round(self.ratio, 4)}


def scale_drift(graph: Snapshot, keyframes: Sequence[Keyframe]) -> ScaleDrift | None:
    """From the units that loops and telemetry gave the keyframes along each chain of links: as it
    was tracked, a keyframe has the unit of the one before. None without links."""
    links = graph.edges[~graph.edges["loop"]]
    if not len(links):
        return None
    drift, count = -np.log(graph.nodes["scale"]), len(graph.nodes)
    linked = coo_array((np.ones(len(links)), (links["a"], links["b"])), (count, count))
    chains, chain_of = connected_components(linked, directed=False)
    largest = max(
        (np.flatnonzero(chain_of == chain) for chain in range(chains)),
        key=lambda rows: float(np.ptp(drift[rows])),
    )
    ends = sorted((largest[np.argmin(drift[largest])], largest[np.argmax(drift[largest])]))
    first, last = (keyframes[graph.nodes["number"][row]].frame_index for row in ends)
    return ScaleDrift(first, last, float(np.exp(drift[ends[1]] - drift[ends[0]])))
