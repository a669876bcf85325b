"""The frontend: every frame's pose against the latest keyframe, and its class (paper, Sec. 3.2)."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from aquaflow.config import TrackingConfig
from aquaflow.errors.failures import Failures
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, KeyframeStore, Pointmap
from aquaflow.messages import Frame
from aquaflow.prior.contract import Encoding, PairGeometry, Prior
from aquaflow.tracking.current_keyframe import Attachment, Follower
from aquaflow.tracking.frames import FrameClass, Link, Tracked
from aquaflow.tracking.initialisation.back_fill import BackFill
from aquaflow.tracking.initialisation.initialiser import Initialiser, calibrated, fused_pointmap
from aquaflow.tracking.loops.relocaliser import Places

MAX_ORPHANS = 60
"""Frames without a pose that are kept for back-filling; bounds memory while nothing moves."""

MAX_PAST = 120
"""Frames that a live run keeps until it has time for them; likewise."""


class Tracker:
    """One camera, one stream; a loss starts a new sub-map instead of failing."""

    def __init__(
        self,
        prior: Prior,
        keyframes: KeyframeStore,
        config: TrackingConfig,
        places: Places | None = None,
        live: bool = False,
        failures: Failures | None = None,
    ) -> None:
        """Without ``places``, what was lost is never found again, only begun anew.

        Once a map has started, or a place was found again, the frames that waited for it get their
        poses at once, or, in a ``live`` run, whenever there is time: see :meth:`back_fill`.
        What raises is counted in ``failures``, and the frame is one that could not be placed.
        """
        self.sub_map = 0
        self.camera: CameraModel | None = None
        """The camera as refined by initialisation, once known."""
        self.focal_sigma = 0.0
        self._prior, self._keyframes, self._config = prior, keyframes, config
        self._places, self._follower = places, Follower(prior, keyframes, config)
        self._failures = failures or Failures()
        self._sub_maps = 1
        self._initialiser: Initialiser | None = None
        self._orphans: list[Frame] = []
        """Frames without a pose, which wait for a keyframe that shows their place."""
        self._live = live
        self._past: deque[BackFill] = deque()
        self._at: Attachment | None = None
        self._lost: list[Frame] = []
        self._origin = Sim3.identity()

    def track(self, frame: Frame) -> list[Tracked]:
        """Poses that this frame makes known: none while waiting, several when waiting ends."""
        encoding = self._encode(frame)
        if encoding is None:
            return [self._as_lost(frame)]
        if self._at is None:
            return self._find_again(frame, encoding) or self._initialise(frame, encoding)
        tracked = self._follow(frame, encoding)
        found = [tracked] if tracked is not None else self._find_again(frame, encoding)
        if found:
            self._orphans, self._lost = self._orphans + self._lost, []
            return [*self._back_fill(), *found]
        self._lost.append(frame)
        if len(self._lost) >= self._config.lost_after:
            return self._start_sub_map()
        return []

    @property
    def past(self) -> Frame | None:
        """The frame whose turn it is at :meth:`back_fill`."""
        return next((fill.frames[-1] for fill in self._past if fill.frames), None)

    def back_fill(self) -> list[Tracked]:
        """The pose of :attr:`past`, or that it has none; nothing if no frame waits."""
        while self._past and not self._past[0].frames:
            self._past.popleft()
        return [self._past[0].step()] if self._past else []

    def _encode(self, frame: Frame) -> Encoding | None:
        with self._failures.contain("encoding", frame.index):
            return self._prior.encode(frame.image, self.camera or frame.camera)
        return None

    @property
    def lost(self) -> bool:
        """True while the latest frames found no place on the keyframe in use."""
        return bool(self._lost)

    @property
    def sub_maps(self) -> int:
        """Sub-maps that were begun so far."""
        return self._sub_maps

    def resume(self, camera: CameraModel, focal_sigma: float, sub_maps: int, T_wc: Sim3) -> None:
        """Go on with keyframes of an earlier run: look for a known place, and until one is found
        grow a new sub-map from ``T_wc``, the last pose."""
        self.camera, self.focal_sigma = camera, focal_sigma
        self.sub_map, self._sub_maps = sub_maps, sub_maps + 1
        self._origin = T_wc

    def recall(self, keyframe: Keyframe) -> None:
        """An earlier run's keyframe may be taken up again."""
        self._follower.leave(Attachment(keyframe))

    def finish(self) -> list[Tracked]:
        """Account for the frames that never got a pose; tries one last time with what there is."""
        tracked: list[Tracked] = []
        if self._at is None and self._initialiser is not None and self._initialiser.waiting:
            tracked = self._begin(self._initialiser)
        tracked += [past for fill in self._past for past in fill.all()]
        self._past.clear()
        left = self._orphans + self._lost
        self._orphans, self._lost = [], []
        if self._at is None and self._initialiser is not None:
            left += self._waiting_frames(self._initialiser)
        return tracked + [self._as_lost(frame) for frame in left]

    # --- initialisation -----------------------------------------------------------------------

    def _initialise(self, frame: Frame, encoding: Encoding) -> list[Tracked]:
        if self._initialiser is None:
            self._restart(frame, encoding)
            return []
        matched = False  # so are frames that cannot be: the next reference is another one
        with self._failures.contain("initialisation", frame.index):
            matched = self._initialiser.add(frame, encoding)
        if matched and not self._initialiser.ready:
            return self._forget_oldest_orphans()
        tracked = self._begin(self._initialiser) if self._initialiser.waiting else []
        if self._at is None:
            if not matched:
                self._orphans += self._waiting_frames(self._initialiser)
                self._restart(frame, encoding)
            return self._forget_oldest_orphans()
        return tracked if matched else tracked + self.track(frame)

    def _restart(self, frame: Frame, encoding: Encoding) -> None:
        self._initialiser = Initialiser(frame, encoding, self._prior, self._config.initialisation)

    def _begin(self, initialiser: Initialiser) -> list[Tracked]:
        """Turn a decided geometry into the first keyframe, and pose every frame that waited."""
        solution = None
        with self._failures.contain("initialisation", initialiser.frame.index):
            solution = initialiser.solve()
        if solution is None:
            return []
        camera = calibrated(solution.camera)
        if self.camera is None:
            self.camera, self.focal_sigma = camera, solution.focal_sigma
        reference = initialiser.frame
        encoding = self._prior.encode(reference.image, camera)
        pointmap = fused_pointmap(solution, camera, self._config.sigma_px)
        self._orphans += initialiser.thinned
        self._initialiser = None
        self._make_keyframe(reference, encoding, self._origin, pointmap)
        assert self._at is not None
        start = self._at
        number, shown = start.keyframe.number, pointmap.copy()
        first = Tracked(
            reference, FrameClass.KEYFRAME, self.sub_map, number, self._origin, pointmap=shown
        )
        # A live run goes on from the newest frame.
        now = len(solution.waiting) - 1 if self._live else 0
        self._orphans += [waiting.frame for waiting in solution.waiting[:now]]
        tracked = [first, *self._back_fill()]
        for waiting, T in zip(solution.waiting[now:], solution.T[now:], strict=True):
            on_reference = self._at is start
            if on_reference:
                start.T_fk = T
            encoded, result = self._encode(waiting.frame), None
            if encoded is not None:
                pair = waiting.pair if on_reference else None
                result = self._follow(waiting.frame, encoded, pair)
            tracked.append(result or self._as_lost(waiting.frame))
        return tracked

    def _back_fill(self) -> list[Tracked]:
        """Poses of earlier frames that could not start a map, against the keyframe in use."""
        assert self._at is not None
        assert self.camera is not None
        orphans, self._orphans = self._orphans, []
        fill = BackFill(orphans, self._at, self.camera, self._prior, self._follower, self._failures)
        if not self._live:
            return fill.all()
        self._past.append(fill)
        return self._forget_oldest_past()

    def _forget_oldest_past(self) -> list[Tracked]:
        surplus = sum(len(fill.frames) for fill in self._past) - MAX_PAST
        forgotten: list[Frame] = []
        for fill in self._past:
            count = max(0, surplus - len(forgotten))
            forgotten += fill.frames[:count]
            fill.frames = fill.frames[count:]
        return [self._as_lost(frame, "no time to look back") for frame in forgotten]

    def _waiting_frames(self, initialiser: Initialiser) -> list[Frame]:
        return [*initialiser.thinned, initialiser.frame, *(w.frame for w in initialiser.waiting)]

    def _forget_oldest_orphans(self) -> list[Tracked]:
        surplus = max(0, len(self._orphans) - MAX_ORPHANS)
        forgotten, self._orphans = self._orphans[:surplus], self._orphans[surplus:]
        return [self._as_lost(frame, "no parallax yet") for frame in forgotten]

    # --- finding a place again ----------------------------------------------------------------

    def _find_again(self, frame: Frame, encoding: Encoding) -> list[Tracked]:
        """Go on at an earlier keyframe that shows the lost frame's place; nothing if none does.

        Frames that waited for a new sub-map get their poses there too, where they can.
        """
        if self._places is None or self.camera is None:
            return []
        before, there = self._at, None
        with self._failures.contain("relocalisation", frame.index):
            found = self._places.of_frame(encoding, self.camera)
            if found is not None:
                keyframe = self._keyframes.hold(found.keyframe.number)
                there = Attachment(keyframe, T_fk=found.estimate.T)
        if there is None:
            return []
        self._at = there
        tracked = self._follow(frame, encoding)
        if tracked is None:
            self._at = before
            if before is not None:
                self._keyframes.hold(before.keyframe.number)
            return []
        if before is not None:
            self._follower.leave(before)
        if self._initialiser is not None:
            self._orphans += self._waiting_frames(self._initialiser)
            self._initialiser = None
        return [*self._back_fill(), tracked]

    # --- following a keyframe -----------------------------------------------------------------

    def _follow(
        self, frame: Frame, encoding: Encoding, pair: PairGeometry | None = None
    ) -> Tracked | None:
        """Pose, fusion and class of one frame; None when it cannot be placed."""
        with self._failures.contain("pose", frame.index):
            return self._placed(frame, encoding, pair)
        return None

    def _placed(
        self, frame: Frame, encoding: Encoding, pair: PairGeometry | None
    ) -> Tracked | None:
        assert self._at is not None
        assert self.camera is not None
        at, camera, follower = self._at, self.camera, self._follower
        solved = follower.place(at, encoding, camera, pair)
        if solved is None:
            return None
        follower.take(at, solved, camera)
        if follower.hidden(solved):  # the map learns from what is not
            shown = follower.shown(at, solved, camera)
            frame = replace(frame, mask=shown if frame.mask is None else shown & frame.mask)
        frame_class = follower.classify(at, solved, camera)
        if frame_class is FrameClass.KEYFRAME:
            earlier = follower.earlier(at, encoding, camera)
            if earlier is not None:
                follower.leave(at)
                self._at, solved = earlier
                frame_class = FrameClass.COMMON
        if frame_class is FrameClass.COMMON:
            return self._at.tracked(frame, frame_class, solved.quality)
        pointmap = follower.pointmap(at, solved, camera)
        link = None
        if frame_class is FrameClass.KEYFRAME:
            link = Link(at.keyframe.number, solved.estimate.T, solved.estimate.covariance)
            self.sub_map = at.keyframe.sub_map
            follower.leave(at)
            self._make_keyframe(frame, encoding, at.T_wc, pointmap)
        else:
            at.mapped_parallax_px = solved.parallax_px
        # A new keyframe is already in use, with the identity as its relative pose.
        return self._at.tracked(frame, frame_class, solved.quality, pointmap.copy(), link)

    # --- bookkeeping --------------------------------------------------------------------------

    def _make_keyframe(
        self, frame: Frame, encoding: Encoding, T_wc: Sim3, pointmap: Pointmap
    ) -> None:
        keyframe = self._keyframes.add(
            frame.index, frame.t_ns, encoding, T_wc, pointmap, self.sub_map
        )
        motion = Sim3.identity() if self._at is None else self._at.motion
        self._at = Attachment(keyframe, frame.image, motion=motion)

    def _start_sub_map(self) -> list[Tracked]:
        """Give the lost frames to a new sub-map that starts where the old one ended."""
        assert self._at is not None
        self._origin = self._at.T_wc
        self.sub_map, self._sub_maps = self._sub_maps, self._sub_maps + 1
        self._follower.leave(self._at)
        self._at = None
        lost, self._lost = self._lost, []
        tracked = []
        for frame in lost:
            tracked += self.track(frame)
        return tracked

    def _as_lost(self, frame: Frame, reason: str = "no pose found") -> Tracked:
        return Tracked.lost(frame, self.sub_map, self._failures.reason(frame.index) or reason)
