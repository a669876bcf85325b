"""A recording without calibration is looked at twice: first to find its lens, then to map it.

The first pass tracks from the beginning until the lens is known well enough, or for as many frames
as it may. Its poses are rough where the guess was wrong; the adjustment of the lens corrects them.
Where they do not hang together, because the guess lost frames or broke the map into sub-maps, the
pass is repeated with what it found; if that does not help, with each focal length that may be.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.errors.failures import Failures
from aquaflow.config import Config
from aquaflow.dive.found_camera import FoundCamera, usable
from aquaflow.geometry.camera import CameraModel, guess_camera
from aquaflow.geometry.lens_error import TERMS
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe
from aquaflow.prior.contract import Keypoints
from aquaflow.slam import Slam
from aquaflow.sources import CameraSource
from aquaflow.sources.preprocessing import Preparation
from aquaflow.tracking.frames import Tracked
from aquaflow.tracking.lens_views import LensViews
from aquaflow.tracking.overlay.finder import OverlayFinder
from aquaflow.tracking.self_calibration import FoundLens, found_lens
from aquaflow.types import Frame

MOST_FRAMES = 600
"""Looked at for the lens: a minute of the dive at 10 frames/s, and a minute of two cores."""
MOST_FRAMES_OF_A_TRY = 150
"""The same at each focal length that may be, where the guess has failed: enough for a start, and a
camera that stands still or sees nothing costs no three minutes."""
GOOD_SIGMA = np.array([0.0075, 0.01])
"""Of log focal length and k1: better than calibrations in water agree with each other."""
REPEAT_OUTSIDE_SHARE = 0.1
"""Frames that are not in the largest sub-map, above which tracking is repeated with what was
found."""
EVERY_PIXEL = 8
"""Of a pointmap, for its median."""

Array = npt.NDArray[np.float64]
Progress = Callable[[int, int | None], None]


def found_in(recording: CameraSource, config: Config, progress: Progress) -> FoundCamera | None:
    """The camera of a recording without calibration; None where its beginning shows too little."""
    first = _Pass(recording, config, progress)
    best = first.run()
    if best is not None and best.is_in_pieces:
        best = _better(best, _Pass(recording, config, progress, best.camera, best.found).run())
    if best is None or best.is_in_pieces:
        factors = config.tracking.initialisation.focal_factors
        for factor in sorted(factors, key=lambda factor: abs(np.log(factor))):
            camera = replace(first.guess.with_focal_scaled(factor), calibrated=True)
            best = _better(
                best, _Pass(recording, config, progress, camera).run(MOST_FRAMES_OF_A_TRY)
            )
            if best is not None and not best.is_in_pieces:
                break
    return None if best is None else FoundCamera(best.camera, best.found, used=True)


@dataclass(frozen=True)
class _Found:
    """What a pass found, and how well its poses hang together."""

    camera: CameraModel
    found: FoundLens
    outside_share: float
    """Of the frames, how many have no pose in the largest sub-map."""

    @property
    def is_in_pieces(self) -> bool:
        return self.outside_share > REPEAT_OUTSIDE_SHARE


def _better(a: _Found | None, b: _Found | None) -> _Found | None:
    """The one that poses more frames together; the later one where both pose as many."""
    if a is None or b is None:
        return a or b
    return a if a.outside_share < b.outside_share else b


class _Pass:
    """Tracking from the beginning, with ``camera`` or the guess, for views of the lens."""

    def __init__(
        self,
        recording: CameraSource,
        config: Config,
        progress: Progress,
        camera: CameraModel | None = None,
        found: FoundLens | None = None,
    ) -> None:
        tracking = config.mapping.model_copy(update={"enabled": False})
        self._config = config.model_copy(update={"mapping": tracking})
        self._recording, self._progress = recording, progress
        self._camera, self._found = camera, found
        self._pictures: dict[int, Frame] = {}
        """As they are, distortion and all, by frame index, until their pose is known."""
        self._overlays = OverlayFinder()
        """In these: what is burned in stays where it is, and looks like a camera that stands still
        in front of it."""
        self.guess = guess_camera(1, 1)
        """Of the pictures; known with the first."""
        self._outside_share = 0.0

    def run(self, most_frames: int = MOST_FRAMES) -> _Found | None:
        """The lens as far as it was found, and can be used."""
        slam = Slam(self._config)
        try:
            found = self._run(slam, most_frames)
        finally:
            slam.close()
        camera = None if found is None else usable(found.camera(self.guess))
        if found is None or camera is None:
            return None
        return _Found(camera, found, self._outside_share)

    def _run(self, slam: Slam, most_frames: int) -> FoundLens | None:
        plain = Preparation(self._config.source, None)
        rectified = (
            plain if self._camera is None else Preparation(self._config.source, self._camera)
        )
        views: LensViews | None = None
        surest: FoundLens | None = None
        for frame in self._frames(most_frames):
            try:
                seen = plain(frame)
                tracked = seen if rectified is plain else rectified(frame)
            except InputError:
                continue
            if views is None:
                self.guess = seen.camera
                views = LensViews(seen.camera)
            self._pictures[frame.index] = self._without_overlay(seen)
            self._take(slam, views, slam.process(tracked))
            if views.full:
                surest = _surer(surest, self._estimate(slam, views))
                if views.complete or (surest is not None and (surest.sigma < GOOD_SIGMA).all()):
                    return surest
                views.thin()
        if views is None:
            return None
        self._take(slam, views, slam.finish_tracking())
        return _surer(surest, self._estimate(slam, views))

    def _frames(self, most: int) -> Iterator[Frame]:
        """Until the recording ends or fails, which the mapping then meets again and counts."""
        source = self._config.source
        events = self._recording.frames(source.every, source.start, source.stop)
        for done in range(1, most + 1):
            event = None
            with Failures(strict=False).contain("reading"):
                event = next(events, None)
            if event is None:
                return
            self._progress(done, None)
            if isinstance(event, Frame):
                yield event

    def _take(self, slam: Slam, views: LensViews, decided: list[Tracked]) -> None:
        for tracked in decided:
            picture = self._pictures.pop(tracked.frame.index)
            if tracked.T_wc is None or tracked.keyframe is None:
                continue
            rho = _nearness(slam.keyframes[tracked.keyframe])
            keypoints = partial(self._keypoints, slam, picture)
            views.offer(tracked.frame.index, tracked.T_wc, tracked.sub_map, rho, keypoints)

    def _without_overlay(self, frame: Frame) -> Frame:
        return self._overlays.mask(frame) if self._config.tracking.mask_overlays else frame

    def _keypoints(self, slam: Slam, picture: Frame) -> Keypoints:
        return slam.prior.encode(picture.image, self.guess, picture.mask).keypoints

    def _estimate(self, slam: Slam, views: LensViews) -> FoundLens | None:
        results = slam.results()
        poses: dict[int, Sim3] = {t.frame.index: t.T_wc for t in results if t.T_wc is not None}
        posed_in = Counter(t.sub_map for t in results if t.T_wc is not None)
        self._outside_share = 1.0 - max(posed_in.values(), default=0) / max(len(results), 1)
        # The first views were taken before the overlay was found.
        shown = [view.where(self._overlays.shown) for view in views.posed_views(poses)]
        return found_lens(shown, self._lens_of(slam.tracker.camera))

    def _lens_of(self, tracked: CameraModel | None) -> Array:
        """[5] the lens that the poses go with, as an error of the guess: what the start of the map
        made of the focal length, or what an earlier pass found."""
        lens = np.zeros(TERMS)
        if self._found is not None:
            lens = self._found.lens
        elif tracked is not None:
            lens[0] = np.log(tracked.fx / self.guess.fx)
        return lens


def _surer(a: FoundLens | None, b: FoundLens | None) -> FoundLens | None:
    """The one whose focal length is known better; views further apart need not show more."""
    if a is None or b is None:
        return a or b
    return a if a.sigma[0] < b.sigma[0] else b


def _nearness(keyframe: Keyframe) -> float:
    """Median inverse depth, 1 / world units; 0 where none is known."""
    rho = keyframe.pointmap.rho[::EVERY_PIXEL, ::EVERY_PIXEL]
    known = rho[rho > 0.0]
    return float(np.median(known)) / keyframe.T_wc.scale if len(known) else 0.0
