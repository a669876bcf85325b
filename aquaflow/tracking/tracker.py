"""The frontend: every frame's pose against the latest keyframe, and its class (paper, Sec. 3.2)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, KeyframeStore, Pointmap
from aquaflow.messages import Frame
from aquaflow.prior.contract import Encoding, PairGeometry, Prior
from aquaflow.tracking.frames import FrameClass, Link, Quality, Tracked
from aquaflow.tracking.fusion import fuse, transfer
from aquaflow.tracking.initialisation import Initialiser, calibrated, fused_pointmap
from aquaflow.tracking.matcher import KeyframeMatcher, Matched
from aquaflow.tracking.places import Places

MAX_ORPHANS = 60
"""Frames without a pose that are kept for back-filling; bounds memory while nothing moves."""


class Tracker:
    """One camera, one stream; a loss starts a new sub-map instead of failing."""

    def __init__(
        self,
        prior: Prior,
        keyframes: KeyframeStore,
        config: TrackingConfig,
        places: Places | None = None,
    ) -> None:
        """Without ``places``, what was lost is never found again, only begun anew."""
        self.sub_map = 0
        self.camera: CameraModel | None = None
        """The camera as refined by initialisation, once known."""
        self.focal_sigma = 0.0
        self._prior, self._keyframes, self._config = prior, keyframes, config
        self._places, self._matcher = places, KeyframeMatcher(config)
        self._sub_maps = 1
        self._initialiser: Initialiser | None = None
        self._orphans: list[Frame] = []
        self._keyframe: Keyframe | None = None
        self._keyframe_image: npt.NDArray[np.uint8] | None = None
        self._T_fk = Sim3.identity()
        self._velocity = Sim3.identity()
        self._predicted: npt.NDArray[np.float32] | None = None
        self._mapped_parallax_px = 0.0
        self._lost: list[Frame] = []
        self._origin = Sim3.identity()

    def track(self, frame: Frame) -> list[Tracked]:
        """Poses that this frame makes known: none while waiting, several when waiting ends."""
        encoding = self._prior.encode(frame.image, self.camera or frame.camera)
        if self._keyframe is None:
            return self._find_again(frame, encoding) or self._initialise(frame, encoding)
        tracked = self._follow(frame, encoding)
        found = [tracked] if tracked is not None else self._find_again(frame, encoding)
        if found:
            lost, self._lost = self._lost, []
            return [self._as_lost(past) for past in lost] + found
        self._lost.append(frame)
        if len(self._lost) >= self._config.lost_after:
            return self._start_sub_map()
        return []

    @property
    def lost(self) -> bool:
        """True while the latest frames found no place on the keyframe in use."""
        return bool(self._lost)

    def finish(self) -> list[Tracked]:
        """Account for the frames that never got a pose; tries one last time with what there is."""
        tracked: list[Tracked] = []
        if self._keyframe is None and self._initialiser is not None and self._initialiser.waiting:
            tracked = self._begin(self._initialiser)
        left = self._orphans + self._lost
        self._orphans, self._lost = [], []
        if self._keyframe is None and self._initialiser is not None:
            left += self._waiting_frames(self._initialiser)
        return tracked + [self._as_lost(frame) for frame in left]

    # --- initialisation -----------------------------------------------------------------------

    def _initialise(self, frame: Frame, encoding: Encoding) -> list[Tracked]:
        if self._initialiser is None:
            self._restart(frame, encoding)
            return []
        matched = self._initialiser.add(frame, encoding)
        if matched and not self._initialiser.ready:
            return self._forget_oldest_orphans()
        tracked = self._begin(self._initialiser) if self._initialiser.waiting else []
        if self._keyframe is None:
            if not matched:
                self._orphans += self._waiting_frames(self._initialiser)
                self._restart(frame, encoding)
            return self._forget_oldest_orphans()
        return tracked if matched else tracked + self.track(frame)

    def _restart(self, frame: Frame, encoding: Encoding) -> None:
        self._initialiser = Initialiser(frame, encoding, self._prior, self._config.initialisation)

    def _begin(self, initialiser: Initialiser) -> list[Tracked]:
        """Turn a decided geometry into the first keyframe, and pose every frame that waited."""
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
        first = Tracked(
            reference,
            FrameClass.KEYFRAME,
            self.sub_map,
            self._number,
            self._origin,
            pointmap=pointmap.copy(),
        )
        tracked = [first, *self._back_fill()]
        for waiting, T in zip(solution.waiting, solution.T, strict=True):
            on_reference = self._number == first.keyframe
            if on_reference:
                self._T_fk = T
            encoded = self._prior.encode(waiting.frame.image, camera)
            result = self._follow(waiting.frame, encoded, waiting.pair if on_reference else None)
            tracked.append(result or self._as_lost(waiting.frame))
        return tracked

    def _back_fill(self) -> list[Tracked]:
        """Poses of earlier frames that could not start a map, against the first keyframe."""
        assert self._keyframe is not None
        assert self.camera is not None
        orphans, self._orphans = self._orphans, []
        tracked = []
        for frame in reversed(orphans):
            encoding = self._prior.encode(frame.image, self.camera)
            solved = self._solve(encoding, None)
            if solved is None:
                tracked.append(self._as_lost(frame))
                continue
            self._T_fk = solved.estimate.T
            tracked.append(self._tracked(frame, FrameClass.COMMON, solved, None))
        self._T_fk = Sim3.identity()
        return tracked[::-1]

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
        found = self._places.of_frame(encoding, self.camera)
        if found is None:
            return []
        before = (self._keyframe, self._T_fk, self._velocity, self._predicted)
        self._keyframe = self._keyframes.hold(found.keyframe.number)
        self._T_fk, self._velocity, self._predicted = found.estimate.T, Sim3.identity(), None
        self._mapped_parallax_px, self._keyframe_image = 0.0, None
        tracked = self._follow(frame, encoding)
        if tracked is None:
            self._keyframe, self._T_fk, self._velocity, self._predicted = before
            if self._keyframe is not None:
                self._keyframes.hold(self._keyframe.number)
            return []
        if self._initialiser is not None:
            self._orphans += self._waiting_frames(self._initialiser)
            self._initialiser = None
        here = (self._T_fk, self._predicted)
        filled = self._back_fill()
        self._T_fk, self._predicted = here
        return [*filled, tracked]

    # --- following a keyframe -----------------------------------------------------------------

    def _follow(
        self, frame: Frame, encoding: Encoding, pair: PairGeometry | None = None
    ) -> Tracked | None:
        """Pose, fusion and class of one frame; None when it cannot be placed."""
        solved = self._solve(encoding, pair)
        if solved is None:
            return None
        assert self._keyframe is not None
        assert self.camera is not None
        T_fk = solved.estimate.T
        self._velocity = T_fk @ self._T_fk.inverse()
        self._T_fk, self._predicted = T_fk, solved.pair.matches
        fuse(self._keyframe.pointmap, solved.pair, T_fk, self.camera, self._config.sigma_px)
        frame_class = self._classify(solved)
        if frame_class is FrameClass.COMMON:
            return self._tracked(frame, frame_class, solved, None)
        pointmap = transfer(
            self._keyframe.pointmap,
            solved.pair.matches_back,
            solved.pair.valid_back,
            T_fk,
            self.camera,
        )
        link = None
        if frame_class is FrameClass.KEYFRAME:
            link = Link(self._number, T_fk, solved.estimate.covariance)
            self.sub_map = self._keyframe.sub_map
            T_wc = self._keyframe.T_wc @ T_fk.inverse()
            self._make_keyframe(frame, encoding, T_wc, pointmap)
        else:
            self._mapped_parallax_px = solved.parallax_px
        return self._tracked(frame, frame_class, solved, pointmap.copy(), link)

    def _solve(self, encoding: Encoding, pair: PairGeometry | None) -> Matched | None:
        """Match against the keyframe and solve the pose."""
        keyframe, camera = self._keyframe, self.camera
        assert keyframe is not None
        assert camera is not None
        if pair is None:
            seed = self._predicted if self._config.seed_matching else None
            pair = self._prior.decode(self._reference(keyframe), encoding, seed)
        return self._matcher.pose(keyframe, camera, pair, self._velocity @ self._T_fk, self._T_fk)

    def _reference(self, keyframe: Keyframe) -> Encoding:
        if self._config.reuse_encodings or self._keyframe_image is None:
            return keyframe.encoding
        return self._prior.encode(self._keyframe_image, keyframe.pointmap.camera)

    def _classify(self, solved: Matched) -> FrameClass:
        """The paper's rules: keyframe by matched share, mapping frame by parallax."""
        if solved.share < self._config.keyframe_share:
            return FrameClass.KEYFRAME
        assert self.camera is not None
        threshold = self._config.mapping_parallax_widths * self.camera.width
        if solved.parallax_px - self._mapped_parallax_px > threshold:
            return FrameClass.MAPPING
        return FrameClass.COMMON

    # --- bookkeeping --------------------------------------------------------------------------

    @property
    def _number(self) -> int:
        assert self._keyframe is not None
        return self._keyframe.number

    def _make_keyframe(
        self, frame: Frame, encoding: Encoding, T_wc: Sim3, pointmap: Pointmap
    ) -> None:
        self._keyframe = self._keyframes.add(
            frame.index, frame.t_ns, encoding, T_wc, pointmap, self.sub_map
        )
        self._keyframe_image = frame.image
        self._T_fk, self._predicted, self._mapped_parallax_px = Sim3.identity(), None, 0.0

    def _tracked(
        self,
        frame: Frame,
        frame_class: FrameClass,
        solved: Matched,
        pointmap: Pointmap | None,
        link: Link | None = None,
    ) -> Tracked:
        assert self._keyframe is not None
        # A new keyframe already is self._keyframe, with the identity as its relative pose.
        T_wc = self._keyframe.T_wc @ self._T_fk.inverse()
        estimate = solved.estimate
        quality = Quality(
            estimate.inlier_share, estimate.residual_px, solved.share, estimate.conditioning
        )
        sub_map, number = self._keyframe.sub_map, self._number
        return Tracked(frame, frame_class, sub_map, number, T_wc, quality, pointmap, link=link)

    def _start_sub_map(self) -> list[Tracked]:
        """Give the lost frames to a new sub-map that starts where the old one ended."""
        assert self._keyframe is not None
        self._origin = self._keyframe.T_wc @ self._T_fk.inverse()
        self.sub_map, self._sub_maps = self._sub_maps, self._sub_maps + 1
        self._keyframe, self._predicted, self._velocity = None, None, Sim3.identity()
        lost, self._lost = self._lost, []
        tracked = []
        for frame in lost:
            tracked += self.track(frame)
        return tracked

    def _as_lost(self, frame: Frame, reason: str = "no pose found") -> Tracked:
        return Tracked(frame, FrameClass.LOST, self.sub_map, reason=reason)
