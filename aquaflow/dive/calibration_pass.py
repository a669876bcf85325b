"""A recording without calibration is looked at twice: first to find its lens, then to map it.

The first pass tracks from the beginning until the lens is known well enough, or for as many frames
as it may. Its poses are rough where the guess was wrong; the adjustment of the lens corrects them.
Where they do not hang together, because the guess lost frames or broke the map into sub-maps, the
pass is repeated with what it found; if that does not help, with each focal length that may be.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import ConfigError, InputError
from aquaflow.base.errors.failures import Failures
from aquaflow.config import Config
from aquaflow.geometry.camera import CameraModel, guess_camera
from aquaflow.geometry.optics import LENS_PRIOR_SIGMA, TERMS, virtual_centre
from aquaflow.geometry.port import FlatPort, Port
from aquaflow.geometry.rectification import Rectifier
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe
from aquaflow.prior.contract import Keypoints
from aquaflow.slam import Slam
from aquaflow.sources import CameraSource
from aquaflow.sources.preprocessing import Preparation
from aquaflow.tracking.calibration_check import (
    MAX_VIEWS,
    TOLERANCE,
    LensError,
    lens_error_of_frames,
    most_turning,
    view_of,
)
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.tracking.overlay import OverlayFinder
from aquaflow.tracking.self_calibration import MOST_VIEWS, FoundLens, LensViews, found_lens
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


# --------------------------------------------------------------------------------------------------
# The camera of a dive without calibration, as its own pictures show it.

log = logging.getLogger(__name__)

UNKNOWN_PERCENT = round(100.0 * float(LENS_PRIOR_SIGMA[0]))
"""Standard deviation of a guessed focal length."""


@dataclass(frozen=True)
class FoundCamera:
    """A calibration with the uncertainty that the dive leaves of it."""

    camera: CameraModel
    """For pictures of the mapped width, distortion and all."""
    lens: FoundLens
    used: bool
    """True if the dive was mapped with it; False if it is known only at the end."""

    def to_json(self) -> dict[str, Any]:
        """The lens as metrics.json has it; px of the mapped width."""
        focal, sigma = self.camera.fx, self.lens.sigma
        return {
            "verdict": "found" if self.lens.known else UNTOLD,
            "used": self.used,
            "focal_px": round(focal, 2),
            "focal_sigma_px": round(focal * float(sigma[0]), 2),
            "focal_widths": round(focal / self.camera.width, 4),
            "k1": round(float(self.lens.lens[1]), 4),
            "k1_sigma": round(float(sigma[1]), 4),
            "noise_px": round(self.lens.noise * focal, 3),
            "keyframes": self.lens.views,
            "matches": self.lens.matches,
        }

    @property
    def suggested(self) -> bool:
        """True if it is good enough for the next dive, and this one did without it."""
        return self.lens.known and not self.used

    @property
    def words(self) -> str:
        """Values, standard deviations, and what they are from."""
        focal, sigma = self.camera.fx, self.lens.sigma
        return (
            f"{focal:.0f} ± {focal * sigma[0]:.0f} px ({100.0 * sigma[0]:.1f} %), radial "
            f"distortion {self.lens.lens[1]:.3f} ± {sigma[1]:.3f}, from {self.lens.views} keyframes"
        )


def in_words(found: FoundCamera | None, tracked: CameraModel, file: str) -> str:
    """A sentence on a dive without calibration, mapped with ``tracked``; ``file`` holds what was
    found too late to be used."""
    guessed = found.camera if found is not None and found.used else tracked
    unknown = f"{guessed.fx:.0f} px is a guess, good to {UNKNOWN_PERCENT} %"
    if found is None:
        return (
            f"no calibration was used, and the pictures do not show the lens: the focal length of "
            f"{unknown}, distortion ignored"
        )
    if not found.lens.known:
        return (
            "no calibration was used, and the camera's motion does not determine its focal "
            f"length: {unknown}; turn the camera while filming, or calibrate it in water"
        )
    if found.used:
        return f"no calibration was used: focal length found to be {found.words}"
    return (
        f"no calibration was used: the dive was mapped with a focal length of {tracked.fx:.0f} "
        f"px and no distortion; at its end the focal length was found to be {found.words}; give "
        f"{file} to the next dive as calibration"
    )


def from_keyframes(keyframes: Sequence[Keyframe]) -> FoundCamera | None:
    """The camera that the keyframes of a finished dive show.

    Raises:
        InputError: a keyframe cannot be read back.
    """
    chosen = most_turning([each for each in keyframes if each.T_wc.is_finite()], MOST_VIEWS)
    views = [view_of(keyframe) for keyframe in chosen]
    lens = found_lens(views)
    if lens is None:
        return None
    camera = usable(lens.camera(views[0].camera))
    return None if camera is None else FoundCamera(camera, lens, used=False)


SEEN_WIDTHS = (0.12, 6.0)
"""Picture widths between which focal lengths under water lie: 153 to 10 degrees of view. Where
poses are wrong, the adjustment can run off to rays that are all parallel: 130 widths on IUI3."""


def usable(camera: CameraModel) -> CameraModel | None:
    """None for a focal length that no camera has, or a distortion that folds the picture over
    itself."""
    possible = SEEN_WIDTHS[0] <= camera.fx / camera.width <= SEEN_WIDTHS[1]
    try:
        Rectifier(camera, camera.width)
    except ConfigError:
        possible = False
    if not possible:
        log.warning("the lens that was found cannot be: %s", camera)
    return camera if possible else None


# --------------------------------------------------------------------------------------------------
# The frames of a dive that may end before it has keyframes enough for the calibration check.


MOST_FRAMES = 16
"""Whose pictures are kept until the dive ends: 6 MB of 480 x 270 px."""


class EarlyViews:
    """Frames of the beginning of a dive with a calibration, evenly; only at the end, and only if
    there were too few keyframes, are keypoints looked for in them."""

    def __init__(self, slam: Slam) -> None:
        self._slam = slam
        self._frames: list[Tracked] = []
        self._seen, self._every = 0, 1

    def take(self, decided: Sequence[Tracked]) -> None:
        """Frames that are finished; of a dive with keyframes enough none is kept."""
        if len(self._slam.keyframes) >= MAX_VIEWS:
            self._frames = []
            return
        for tracked in decided:
            # What repeats an earlier picture has a pose too, and no picture any more.
            repeated = tracked.frame_class is FrameClass.SKIPPED
            if repeated or tracked.T_wc is None or tracked.keyframe is None:
                continue
            if self._seen % self._every == 0:
                self._frames.append(tracked)
            self._seen += 1
            if len(self._frames) == MOST_FRAMES:
                self._frames, self._every = self._frames[::2], 2 * self._every

    def lens_error(self) -> LensError | None:
        """The error of the lens that they show; None if they are too few or show too little."""
        if not self._frames:
            return None
        results = self._slam.results()
        poses = {t.frame.index: t.T_wc for t in results if t.T_wc is not None}
        views = LensViews(self._frames[0].frame.camera)
        for tracked in self._frames:
            frame, T_wc = tracked.frame, poses.get(tracked.frame.index)
            if T_wc is None or tracked.keyframe is None:
                continue
            rho = _nearness(self._slam.keyframes[tracked.keyframe])
            views.offer(frame.index, T_wc, tracked.sub_map, rho, partial(self._keypoints, frame))
        return lens_error_of_frames(views.posed_views(poses))

    def _keypoints(self, frame: Frame) -> Keypoints:
        return self._slam.prior.encode(frame.image, frame.camera, frame.mask).keypoints


# --------------------------------------------------------------------------------------------------
# What the calibration check found, for metrics.json and in words.

REMEDY = (
    "calibrate the camera in water, or in air with its port's measures, or leave out --calib to "
    "have the focal length estimated from the dive; until then distances and shapes are distorted"
)
"""What a user can do about a calibration that does not fit."""
UNTOLD = "cannot be told"
"""Verdict on a calibration where the dive's motion does not determine the lens."""


def to_json(error: LensError, calibration: CameraModel) -> dict[str, Any]:
    """For metrics.json; None where the dive does not determine it. The noise of the matches is in
    px of the calibration's own pictures."""
    focal_known, radial_known = np.logical_or(error.known, error.named)
    focal, k1 = _fitting(error, calibration)
    return {
        "verdict": verdict(error),
        "focal_px": round(focal, 1) if focal_known else None,
        "focal_sigma_px": round(focal * float(error.sigma[0]), 1),
        "focal_given_px": round(calibration.fx, 1),
        "k1": round(k1, 4) if radial_known else None,
        "k1_sigma": round(float(error.sigma[1]), 4),
        "k1_given": _k1(calibration),
        "noise_px": {
            "as_given": round(error.noise_given * calibration.fx, 3),
            "focal_and_k1_fitted": round(error.noise_fitted * calibration.fx, 3),
            "further_terms_fitted": round(error.noise_further * calibration.fx, 3),
        },
        "chance": float(f"{error.chance:.1e}"),
        "keyframes": error.views,
        "matches": error.matches,
    }


def verdict(error: LensError) -> str:
    """One of ``wrong``, ``fits`` and ``UNTOLD``."""
    if error.wrong:
        return "wrong"
    return "fits" if all(error.known) else UNTOLD


def can_tell(error: LensError | None) -> bool:
    """Whether the dive shows if its calibration fits."""
    return error is not None and verdict(error) != UNTOLD


def warning(error: LensError, calibration: CameraModel) -> str:
    """A sentence for a wrong calibration: the error, its certainty, the remedy."""
    focal, k1 = _fitting(error, calibration)
    focal_named, radial_named = error.named
    asked = []
    if focal_named or not radial_named:
        asked.append(
            f"a focal length of {focal:.0f} px (standard deviation "
            f"{focal * error.sigma[0]:.0f}) instead of {calibration.fx:.0f} px"
        )
    if radial_named or not focal_named:
        asked.append(
            f"a first radial distortion k1 of {k1:.3f} (standard deviation "
            f"{error.sigma[1]:.3f}) instead of {_k1(calibration):.3f}"
        )
    return (
        f"the calibration does not fit the dive: its pictures ask for {' and '.join(asked)}; a "
        f"calibration good to {100.0 * TOLERANCE[0]:.0f} % would look so by chance once in "
        f"{_times(error.chance)} dives; {REMEDY}"
    )


def port_note(calibration: CameraModel, port: Port) -> str:
    """Through which port the pictures were rectified."""
    size = (
        f"{port.distance_m:g} m before {port.thickness_m:g} m of glass"
        if isinstance(port, FlatPort)
        else f"{port.radius_m:g} m in radius, {port.thickness_m:g} m thick"
    )
    behind = -1e3 * float(virtual_centre(calibration)[2])
    where = f"{abs(behind):.1f} mm {'behind' if behind >= 0.0 else 'ahead of'} the lens"
    return (
        f"the pictures were rectified through a {port.kind} port ({size}, water of index "
        f"{port.water:.4f}), exactly at {port.range_m:g} m; the path is that of a point {where}"
    )


def _times(chance: float) -> str:
    return "more than a million" if chance < 1e-6 else f"{10 ** int(-np.log10(chance)):,}"


def _fitting(error: LensError, calibration: CameraModel) -> tuple[float, float]:
    """Focal length, px of the calibration, and k1 that fit the dive."""
    growth = float(np.exp(error.log_focal))
    return calibration.fx * growth, error.radial + _k1(calibration) * growth**2


def _k1(calibration: CameraModel) -> float:
    return calibration.distortion[0] if calibration.is_distorted else 0.0
