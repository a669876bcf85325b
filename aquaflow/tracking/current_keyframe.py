"""Tracking against the current keyframe; what moves by itself there; keyframe selection.

The paper makes a keyframe where the share of matches falls below a limit. That is right where the
view has moved on, and only there: of a picture full of marine snow every match is missing too, and
the frame should still show all of the keyframe. And where the vehicle is back at a keyframe that it
left, that one is taken up again: hovering adds none.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import UNKNOWN_VARIANCE, Keyframe, KeyframeStore, Pointmap
from aquaflow.optimise.robust import MAD_TO_SIGMA
from aquaflow.prior.contract import Encoding, Float, Mask, PairGeometry, Prior
from aquaflow.tracking.frames import FrameClass, Quality, Tracked
from aquaflow.tracking.learned import LearnedDepth, add_learned
from aquaflow.tracking.loops import Neighbour, Neighbours
from aquaflow.tracking.pose.depth_fusion import fuse, transfer
from aquaflow.tracking.pose.matcher import (
    KeyframeMatcher,
    Matched,
    agreeing,
    expected_matches,
    is_wide,
    predicted_matches,
)
from aquaflow.tracking.wide_steps import WideSteps, match_by_chance
from aquaflow.types import Frame

RETURN_WIDTHS = 0.03
"""Of an earlier keyframe: distance over width between where the graph and where the matches put
its points; further, the graph has drifted, and a new keyframe closes the loop."""
MIN_SEEN = 0.55
"""Of what a frame should show of its keyframe, by their poses, the share matched as the pose
says, below which something hides the scene and no keyframe is made; measured where a keyframe
falls due: reef, Curasao and surveys over 0.89, IUI3 (weak calibration) over 0.64; snow over 40
% of the pixels of the reef clip below 0.49."""
KEYFRAME_OVERLAP = 0.5
"""Predicted share of the keyframe in view below which a new one is made even of a frame that
hides the scene; a keyframe full of flakes loses the depth under them, so late: on the reef
clip, one made at 0.8 kept the depth of 15 % of its pixels."""


@dataclass
class CurrentKeyframe:
    """The current keyframe and the last frame's pose against it."""

    keyframe: Keyframe
    image: npt.NDArray[np.uint8] | None = None
    """Its picture, while it may still be encoded again."""
    mask: Mask | None = None
    """[H, W] of ``image``."""
    T_fk: Sim3 = field(default_factory=Sim3.identity)
    motion: Sim3 = field(default_factory=Sim3.identity)
    """From the frame before to the last one; while a frame is placed, what it is expected to be."""
    interval_ns: int = 0
    """Between the frames of ``motion``; 0 while it is not known."""
    after_gap: bool = False
    """No picture came for so long before the frame that is placed, or before those lost since, that
    nothing says how far the camera went."""
    matches: Float | None = None
    """[H, W, 2] px of the last frame: where the next one's are looked for."""
    t_ns: int = 0
    """Moment of the last frame."""
    kept: tuple[int, float] | None = None
    """Moment, and matched share, when it last stayed in use in a crowded place, for no other
    keyframe showed more."""
    mapped_parallax_px: float = 0.0
    """Parallax of the last frame that went into the map."""

    @property
    def T_wc(self) -> Sim3:
        """Pose of the last frame."""
        return self.keyframe.T_wc @ self.T_fk.inverse()

    def expect(self, t_ns: int, measured: Sim3 | None) -> None:
        """Set the ``motion`` until ``t_ns``: as telemetry measured it, or the last one's again, as
        much longer or shorter as the time since then."""
        interval_ns = t_ns - self.t_ns if self.t_ns > 0 else 0
        if measured is not None:
            self.motion, self.after_gap = measured, False
        elif interval_ns > 0 and self.interval_ns > 0:
            stretch = interval_ns / self.interval_ns
            self.after_gap |= stretch > MOST_STRETCH
            if 1.0 / MOST_STRETCH <= stretch <= MOST_STRETCH:
                self.motion = Sim3.exp(stretch * self.motion.log())
        self.interval_ns = interval_ns

    def moved_to(
        self,
        T_fk: Sim3,
        matches: Float,  # [H, W, 2] px
    ) -> None:
        """Update after a frame got its pose."""
        self.motion = T_fk @ self.T_fk.inverse()
        self.T_fk, self.matches, self.after_gap = T_fk, matches, False

    def tracked_result(
        self,
        frame: Frame,
        frame_class: FrameClass,
        quality: Quality,
        pointmap: Pointmap | None = None,
    ) -> Tracked:
        """The result for the last frame."""
        sub_map, number = self.keyframe.sub_map, self.keyframe.number
        return Tracked(frame, frame_class, sub_map, number, self.T_wc, quality, pointmap)


def only_where(
    frame: Frame,
    shown: Mask,  # [H, W]
) -> Frame:
    """The frame with its mask limited to ``shown``."""
    return replace(frame, mask=shown if frame.mask is None else shown & frame.mask)


MOST_STRETCH = 4.0
"""Times as long or short as the last motion's interval; beyond, a vehicle has turned since then, or
a clock was set."""
SCARCE = 3.0
"""Times ``min_support``: a keyframe that shows less of a frame is left, whatever hides it; another
such step, and the camera is lost."""


class KeyframeTracker:
    """Tracks frames against keyframes and classifies them."""

    def __init__(self, prior: Prior, keyframes: KeyframeStore, config: TrackingConfig) -> None:
        self._prior, self._keyframes, self._config = prior, keyframes, config
        self._matcher, self.neighbours = KeyframeMatcher(config), Neighbours(config)
        self._wide_steps = WideSteps(prior, self._matcher, config)
        self._recent: deque[Keyframe] = deque(maxlen=config.recent_keyframes)

    def place(
        self,
        at: CurrentKeyframe,
        encoding: Encoding,
        camera: CameraModel,
        pair: PairGeometry | None = None,
    ) -> Matched | None:
        """The frame's pose against the current keyframe; None where too few matches support one.

        After a gap none that much of the picture contradicts: pictures of two places may have a
        fifth of their matches in common. What is then found is found by keypoints.
        """
        solved = self._place(at, encoding, camera, pair)
        unsure = solved is not None and at.after_gap and self._wide_steps.is_contradicted(solved)
        return None if unsure else solved

    def _place(
        self,
        at: CurrentKeyframe,
        encoding: Encoding,
        camera: CameraModel,
        pair: PairGeometry | None,
    ) -> Matched | None:
        predicted, seed = at.motion @ at.T_fk, None
        if pair is None:
            seed = self._seed(at, predicted, camera)
            pair = self._prior.decode(self._reference(at), encoding, seed)
        solved = self._matcher.pose(at.keyframe, camera, pair, predicted, at.T_fk)
        if solved is None and seed is not None:
            # After a wide step flow may hold on to a neighbour: on tiles it comes back from there.
            pair = self._prior.decode(self._reference(at), encoding)
            solved = self._matcher.pose(at.keyframe, camera, pair, predicted, at.T_fk)
        keyframe, wide = at.keyframe, self._wide_steps
        if solved is not None and wide.is_contradicted(solved):
            reference = self._reference(at)
            solved = wide.confirm(keyframe, reference, encoding, camera, solved, predicted)
        if wide.doubtful(keyframe, solved, at.T_fk, predicted, camera):
            reference = self._reference(at)
            return wide.best(keyframe, reference, encoding, camera, solved, predicted)
        return solved

    def place_after_turn(
        self, at: CurrentKeyframe, encoding: Encoding, camera: CameraModel, solved: Matched | None
    ) -> Matched | None:
        """``solved``, unless the frame shows hardly anything of the keyframe that has a depth
        yet: the little that is known fits any pose."""
        if solved is not None and solved.known_share >= self._config.least_known_share:
            return solved
        if at.after_gap:  # the step before says nothing of this one's length
            return None
        reference, predicted = self._reference(at), at.motion @ at.T_fk
        turned = self._wide_steps.after_turn(at.keyframe, reference, encoding, camera, predicted)
        by_chance = solved is not None and match_by_chance(solved.pair)
        return turned or (None if by_chance else solved)

    def _seed(self, at: CurrentKeyframe, predicted: Sim3, camera: CameraModel) -> Float | None:
        """Where the frame's matches are looked for first: at the last ones, or, where a wide motion
        is expected since then, where that leads to."""
        if not self._config.seed_matching:
            return None
        if is_wide(at.keyframe.pointmap, at.T_fk, predicted, camera):
            return expected_matches(at.keyframe.pointmap, predicted, camera)
        return at.matches

    def _reference(self, at: CurrentKeyframe) -> Encoding:
        if self._config.reuse_encodings or at.image is None:
            return at.keyframe.encoding
        return self._prior.encode(at.image, at.keyframe.pointmap.camera, at.mask)

    def take(self, at: CurrentKeyframe, solved: Matched, camera: CameraModel) -> None:
        """Update the motion prediction and the keyframe's depths from the frame."""
        T_fk, pointmap = solved.estimate.T, at.keyframe.pointmap
        at.moved_to(T_fk, solved.pair.matches)
        if self.is_hidden(solved):  # flakes have matches, too; the scene is where the pose puts it
            known = pointmap.is_known(self._config.known_sigma)
            at.matches = predicted_matches(pointmap, known, T_fk, camera, solved.pair.matches)
        fuse(pointmap, solved.pair, T_fk, camera, self._config.sigma_px)

    def solve_again(self, at: CurrentKeyframe, solved: Matched, camera: CameraModel) -> Matched:
        """The last frame's pose against depths that have changed since."""
        T_fk = solved.estimate.T
        again = self._matcher.pose(at.keyframe, camera, solved.pair, T_fk, T_fk)
        if again is None:
            return solved
        at.T_fk = again.estimate.T
        return again

    def is_hidden(self, solved: Matched) -> bool:
        """True if something in front of the scene hides the matches, where that is judged."""
        return self._config.judge_hidden and solved.visibility.seen < MIN_SEEN

    def classify(self, at: CurrentKeyframe, solved: Matched, camera: CameraModel) -> FrameClass:
        """The paper's rules, keyframe by matched share and mapping frame by parallax; but what is
        hidden is neither, unless the keyframe goes out of view."""
        config = self._config
        hidden = self.is_hidden(solved)
        leaving = solved.visibility.overlap < KEYFRAME_OVERLAP
        leaving |= solved.support < SCARCE * config.min_support
        if solved.share < config.keyframe_share and (leaving or not hidden):
            return FrameClass.KEYFRAME
        threshold = config.mapping_parallax_widths * camera.width
        if not hidden and solved.parallax_px - at.mapped_parallax_px > threshold:
            return FrameClass.MAPPING
        return FrameClass.COMMON

    def pointmap(
        self, at: CurrentKeyframe, solved: Matched, camera: CameraModel
    ) -> tuple[Pointmap, LearnedDepth | None]:
        """The keyframe's depths in the frame's own pixels, and the prior's where it knows them. Of
        a frame that is hidden, or whose matches contradict its pose, only those of matches that are
        where that puts them: on tiles a third of the others are those of the next one."""
        pair, T_fk, pointmap = solved.pair, solved.estimate.T, at.keyframe.pointmap
        doubtful = self.is_hidden(solved) or self._wide_steps.is_contradicted(solved)
        reliable = self.shown_pixels(at, solved, camera) if doubtful else pair.valid_back
        own = transfer(pointmap, pair.matches_back, reliable, T_fk, camera)
        config, known, unit = self._config, self._config.known_sigma, pair.range_unit

        def before() -> Pointmap:
            return transfer(pointmap.complete(known), pair.matches_back, reliable, T_fk, camera)

        return own, add_learned(own, pair.X_b, pair.Q_b, known, config.learned, unit, before)

    def without_moving(
        self,
        frame: Frame,
        at: CurrentKeyframe,
        solved: Matched,
        pointmap: Pointmap,
        depth: LearnedDepth,
    ) -> tuple[Frame, Pointmap]:
        """The frame and its pointmap without the pixels that move by themselves: masked, and
        without a learned depth."""
        if not self._config.learned.moving:
            return frame, pointmap
        pair, T_kf = solved.pair, solved.estimate.T.inverse()
        camera = at.keyframe.pointmap.camera
        seen = SeenBefore(camera, T_kf, pair.matches_back, pair.valid_back, at.image, frame.image)
        moves = moving(pointmap, depth, seen)
        return only_where(frame, ~moves), pointmap.not_learned(moves)

    def shown_pixels(self, at: CurrentKeyframe, solved: Matched, camera: CameraModel) -> Mask:
        """[H, W] pixels of the frame that show what the keyframe shows."""
        pair, pointmap = solved.pair, at.keyframe.pointmap
        return agreeing(pointmap, pair.matches_back, pair.valid_back, solved.estimate.T, camera)

    def without_hidden(
        self, frame: Frame, at: CurrentKeyframe, solved: Matched, camera: CameraModel
    ) -> Frame:
        """The frame with its mask limited to pixels that the keyframe shows too."""
        return only_where(frame, self.shown_pixels(at, solved, camera))

    def at_new_keyframe(
        self,
        frame: Frame,
        encoding: Encoding,
        T_wc: Sim3,
        pointmap: Pointmap,
        sub_map: int,
        motion: Sim3 | None = None,
    ) -> CurrentKeyframe:
        """The frame as a keyframe; ``motion``: from the frame before it."""
        keyframe = self._keyframes.add(frame.index, frame.t_ns, encoding, T_wc, pointmap, sub_map)
        motion = motion or Sim3.identity()
        return CurrentKeyframe(keyframe, frame.image, frame.mask, motion=motion, t_ns=frame.t_ns)

    # --- keyframes left behind ----------------------------------------------------------------

    def register(self, at: CurrentKeyframe) -> None:
        """Register the keyframe, so that tracking may return to it."""
        self.neighbours.add(at.keyframe)
        self._recent.append(at.keyframe)

    def recent(
        self, at: CurrentKeyframe | None, encoding: Encoding, camera: CameraModel
    ) -> CurrentKeyframe | None:
        """One of the keyframes left last that shows a frame which ``at``, the one in use, does not:
        keypoints say where, dense matches whether. The first frame after a loss is often still in
        view of one, where it is not of the last."""
        others = (each for each in reversed(self._recent) if at is None or each is not at.keyframe)
        for keyframe, solved in self._showing(others, encoding, camera):
            with contextlib.suppress(InputError):  # it cannot be read back
                self._keyframes.load(keyframe.number)
                T_fk, matches = solved.estimate.T, solved.pair.matches
                return CurrentKeyframe(keyframe, T_fk=T_fk, matches=matches)
        return None

    def tracked_at(
        self, keyframes: Sequence[Keyframe], frame: Frame, encoding: Encoding, camera: CameraModel
    ) -> Tracked | None:
        """A frame at the first of ``keyframes`` that shows it; no keyframe is changed."""
        for keyframe, solved in self._showing(keyframes, encoding, camera):
            there = CurrentKeyframe(keyframe, T_fk=solved.estimate.T)
            return there.tracked_result(frame, FrameClass.COMMON, solved.quality)
        return None

    def _showing(
        self, keyframes: Iterable[Keyframe], encoding: Encoding, camera: CameraModel
    ) -> Iterator[tuple[Keyframe, Matched]]:
        """Those of ``keyframes`` that show a frame; one that cannot be read back is skipped."""
        for keyframe in keyframes:
            try:
                solved = self._wide_steps.shown_by(keyframe, encoding, camera)
            except InputError:
                continue
            if solved is not None:
                yield keyframe, solved

    def take_up(self, back: CurrentKeyframe) -> None:
        """Hold an earlier keyframe in memory: tracking goes on there."""
        self._keyframes.load(back.keyframe.number)

    def shows(self, solved: Matched) -> bool:
        """True if enough was matched to go on at a keyframe."""
        return solved.share >= self._config.crowd_share

    def back_at(
        self,
        neighbour: Neighbour,
        at: CurrentKeyframe,
        encoding: Encoding,
        camera: CameraModel,
        drifted: bool = False,
    ) -> tuple[CurrentKeyframe, Matched] | None:
        """The last frame's pose at an earlier keyframe, where that agrees with its pose; where the
        keyframe in use has ``drifted``, in any case."""
        T_fk = neighbour.T_fk.in_source_unit()
        back = CurrentKeyframe(neighbour.keyframe, T_fk=T_fk)
        try:
            expected = expected_matches(back.keyframe.pointmap, T_fk, camera)
            pair = self._prior.decode(self._reference(back), encoding, expected)
            solved = self.place(back, encoding, camera, pair)
        except InputError:
            return None  # a keyframe that cannot be read back is skipped
        if solved is None or self.is_hidden(solved):
            return None
        shift = camera.project(solved.estimate.T.apply(solved.points))
        shift = np.linalg.norm(shift - camera.project(T_fk.apply(solved.points)), axis=1)
        if not drifted and np.median(shift) > RETURN_WIDTHS * camera.width:
            return None
        back.moved_to(solved.estimate.T, solved.pair.matches)
        back.motion, back.mapped_parallax_px = at.motion, solved.parallax_px
        return back, solved


# --------------------------------------------------------------------------------------------------
# What moves by itself: fish, a diver, the vehicle's own arm (paper, Sec. 3.2: C and Q).
#
# The network looks at shape and not at motion. From its depth and the two poses follows where the
# keyframe before must have shown each pixel. What moves was elsewhere: its match, if it has one,
# lies apart from that place, or gives it a false triangulated depth; and mostly it has none,
# because the keyframe shows something of other colours there. A whole region of such pixels is not
# to be trusted with a place in the map.

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

COMPARED_WIDTH = 160
"""px that pictures are reduced to: the smallest region is then 8 px wide."""
DIFFERS_SIGMAS = 4.0
"""Standard errors by which depths, matches or colours differ if they are of different things
(docs/prior.md#moving has what is found and what is taken for it)."""
MATCH_SIGMA_WIDTHS = 0.003
"""Of a match, over the picture's width: across the epipolar line, where the learned depth has no
part, 95 % of those of still clips and dives lie within 0.001 to 0.003."""
LEAST_GREY = 1.0
"""Standard deviation of colours at matches that is at least assumed, of 255: rounding's."""
ALONG = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Standard errors of the learned depth at which colours are compared: one of them must fit."""
EDGE_WIDTHS = 0.012
"""Of the keyframe's border, over its width: what smoothing mixes with what is not seen."""
LEAST_WIDTHS = 0.05
"""Side of the smallest region, over the picture's width: one and a half cells of a network, whose
error is that of a whole cell."""


@dataclass(frozen=True)
class SeenBefore:
    """A picture's pixels in the keyframe before."""

    camera: CameraModel
    """Of the keyframe."""
    T: Sim3
    """From the picture to the keyframe."""
    matches: Float
    """[H, W, 2] px in the keyframe."""
    matched: Mask
    """[H, W]"""
    before: Picture | None
    """[h, w, 3] the keyframe's picture, while it is kept."""
    now: Picture
    """[H, W, 3] the picture."""


def moving(
    pointmap: Pointmap,
    depth: LearnedDepth,
    seen: SeenBefore,
) -> Mask:
    """[H, W] pixels of the picture that move by themselves, in regions."""
    camera = pointmap.camera
    step = max(1, camera.width // COMPARED_WIDTH)
    grid = np.s_[step // 2 :: step, step // 2 :: step]
    places = _Places(camera.pixel_centres()[grid], depth, grid, camera, seen)
    differs = _by_depths(pointmap, depth)[grid]
    matched = seen.matched[grid] & places.known
    apart = matched & places.apart(seen.matches[grid])
    differs |= apart
    if seen.before is not None:
        differs |= ~(matched & ~apart) & places.other_colours(seen)
    side = max(3, round(LEAST_WIDTHS * differs.shape[1]) | 1)
    kernel = np.ones((side, side), np.uint8)
    opened = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(cv2.dilate(opened, kernel), size, interpolation=0) > 0)


def _by_depths(pointmap: Pointmap, depth: LearnedDepth) -> Mask:
    """[H, W] pixels whose triangulated depth the learned one contradicts."""
    rho, variance = pointmap.rho, pointmap.variance
    both = depth.known & (rho > 1e-6) & (variance < UNKNOWN_VARIANCE)
    ratio = np.log(np.where(both, rho, 1.0) / np.where(both, depth.rho, 1.0))
    own = np.where(both, variance, 0.0) / np.where(both, rho, 1.0) ** 2
    allowed = DIFFERS_SIGMAS * np.sqrt(np.where(both, depth.variance, 1.0) + own)
    return np.asarray(both & (np.abs(ratio) > allowed))


class _Places:
    """Where the keyframe must have shown the pixels of a grid, by their learned depths."""

    def __init__(
        self,
        pixels: Array,  # [h, w, 2] px
        depth: LearnedDepth,
        grid: tuple[slice, slice],
        camera: CameraModel,
        seen: SeenBefore,
    ) -> None:
        self.known, self._grid = depth.known[grid], grid
        z = 1.0 / np.where(self.known, depth.rho[grid], 1.0)
        sigma = np.sqrt(np.where(self.known, depth.variance[grid], 0.0))
        rays = camera.unproject(pixels)
        at = [rays * (z * np.exp(step * sigma))[..., None] for step in ALONG]
        self._at = [seen.camera.project(seen.T.apply(points)) for points in at]
        self._sigma = MATCH_SIGMA_WIDTHS * camera.width

    def apart(
        self,
        matches: Float,  # [h, w, 2] px
    ) -> Mask:
        """[h, w] matches that lie elsewhere: off along the epipolar line by more than the depth's
        error moves them, or across it."""
        off = matches - self._at[len(ALONG) // 2]
        line = 0.5 * (self._at[-1] - self._at[0])
        reach = np.linalg.norm(line, axis=-1)
        along = (off * line).sum(-1) / np.maximum(reach, 1e-9)
        across = (off**2).sum(-1) - along**2
        variance = self._sigma**2
        distance = along**2 / (variance + reach**2) + across / variance
        return np.asarray(distance > DIFFERS_SIGMAS**2)

    def other_colours(
        self,
        seen: SeenBefore,
    ) -> Mask:
        """[h, w] pixels that the keyframe shows in other colours, wherever on its line they are."""
        assert seen.before is not None
        camera, matched = seen.camera, seen.matched[self._grid]
        before, now = (_reduce(picture, *self.known.shape) for picture in (seen.before, seen.now))
        usual = (now - _colours(before, seen.matches[self._grid], camera))[matched]
        if len(usual) == 0:
            return np.zeros_like(self.known)
        middle = np.median(usual, axis=0)
        sigma = np.maximum(MAD_TO_SIGMA * np.median(np.abs(usual - middle), axis=0), LEAST_GREY)
        least = np.full(self.known.shape, np.inf)
        for at in self._at:
            off = (now - _colours(before, at, camera) - middle) / sigma
            least = np.minimum(least, np.sqrt((off**2).mean(-1)))
        middle_at = self._at[len(ALONG) // 2]
        margin = EDGE_WIDTHS * camera.width
        size = (camera.width - margin, camera.height - margin)
        inside = ((middle_at > margin) & (middle_at < size)).all(-1)
        return np.asarray(self.known & inside & (least > DIFFERS_SIGMAS))


def _reduce(
    picture: Picture,  # [H, W, 3]
    height: int,
    width: int,
) -> Float:
    """[height, width, 3] means, a little smoothed: learned depths are not exact."""
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.0), np.float32)


def _colours(
    picture: Float,  # [h, w, 3], reduced
    pixels: npt.NDArray[np.floating],  # [h, w, 2] px of the picture before that
    camera: CameraModel,
) -> Float:
    """[h, w, 3]"""
    scale = picture.shape[1] / camera.width, picture.shape[0] / camera.height
    x, y = np.moveaxis(np.nan_to_num(pixels * scale - 0.5, nan=-1e4).clip(-1e4, 1e4), -1, 0)
    found = cv2.remap(
        picture, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.asarray(found, np.float32)
