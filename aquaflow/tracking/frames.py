"""Frames of tracking: the result of a finished one, and those that wait for a map."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.prior.contract import PairGeometry
from aquaflow.types import Frame


class FrameClass(str, Enum):
    """What a frame is used for (paper, Sec. 3.2), or why it is not used."""

    KEYFRAME = "keyframe"
    """Few matches are left with the keyframe before; joins the graph and brings Gaussians."""
    MAPPING = "mapping"
    """Seen with enough parallax since the last mapped frame; brings Gaussians."""
    COMMON = "common"
    """Neither; refines the Gaussians that are there."""
    SKIPPED = "skipped"
    """Refused by the gate: dark, blurred, blinded, or nothing moved."""
    LOST = "lost"
    """No pose was found."""
    DROPPED = "dropped"
    """Could not be read, or a live run had no time for it."""


@dataclass(frozen=True)
class Quality:
    """Quality of a pose."""

    inlier_share: float = 1.0
    residual_px: float = 0.0
    matched_share: float = 1.0
    conditioning: float = 1.0


@dataclass(frozen=True)
class KeyframeEdge:
    """Relative-pose edge from a new keyframe to its parent."""

    keyframe: int
    """Number of the earlier keyframe."""
    T_fk: Sim3
    """Earlier keyframe to new one."""
    covariance: npt.NDArray[np.float64]
    """[6, 6] of the left tangent [translation, rotation]."""
    pair: PairGeometry | None = None
    """The matches that it was solved from, earlier to new; let go once they were sampled."""


@dataclass(frozen=True)
class Revisit:
    """Relative pose and scale of two keyframes that one frame was matched to."""

    keyframe: int
    earlier: int
    T_ke: Sim3
    """Earlier keyframe to the other."""
    covariance: npt.NDArray[np.float64]
    """[6, 6] of the left tangent [translation, rotation]."""
    scale_sigma: float
    """Of the logarithm of the scale."""


@dataclass(frozen=True)
class Tracked:
    """A frame with its pose, or the reason why it has none."""

    frame: Frame
    frame_class: FrameClass
    sub_map: int
    keyframe: int | None = None
    """Number of the keyframe that the pose is relative to."""
    T_wc: Sim3 | None = None
    quality: Quality = Quality()
    pointmap: Pointmap | None = None
    """Depth of this frame's own pixels; present for keyframes and mapping frames."""
    reason: str = ""

    @staticmethod
    def as_lost(frame: Frame, sub_map: int, reason: str = "no pose found") -> Tracked:
        """A frame that got no pose."""
        return Tracked(frame, FrameClass.LOST, sub_map, reason=reason)

    def bare(self) -> Tracked:
        """A copy without picture and pointmap, small enough to keep for every frame."""
        return replace(self, frame=without_pictures(self.frame), pointmap=None)


class NewDepths(Protocol):
    """Depths of a keyframe that have changed together, and what that makes of poses against it."""

    @property
    def keyframe(self) -> int:
        """Number of the keyframe."""
        ...

    def concerns(self, tracked: Tracked) -> bool:
        """True of a frame whose pose was solved against the old depths."""
        ...

    def correct(self, T_kf: Sim3) -> Sim3:
        """The pose of such a frame in the keyframe, against the new ones."""
        ...


@dataclass(frozen=True)
class Step:
    """What tracking found out with a frame: plain data for the graph, the maps and the table."""

    frames: list[Tracked] = field(default_factory=list)
    """Finished by it, each with its pose or why it has none: that frame, and some before it."""
    links: dict[int, KeyframeEdge] = field(default_factory=dict)
    """Of the new keyframes that continue a sub-map, by their numbers."""
    revisits: list[Revisit] = field(default_factory=list)
    new_depths: list[NewDepths] = field(default_factory=list)
    """Frames finished before are to be carried over to them; those of this step are."""


def without_pictures(frame: Frame) -> Frame:
    """A frame's index, times and camera: its picture and mask are empty."""
    nothing = np.empty((0, 0, 3), np.uint8)
    return replace(frame, image=nothing, mask=None, encoded=None)


# --------------------------------------------------------------------------------------------------
# Unfinished frames of tracking: each is in one state, and leaves once.
#
# A state holds no more than a bound: ``initialising`` thins out beyond
# ``tracking.initialisation.max_waiting``, ``lost`` frames begin a new sub-map at
# ``tracking.lost_after``, and where frames wait without an end the oldest leave without a pose.


class Wait(Enum):
    """What a frame waits for. At a dive's end the remaining frames are finished in this order."""

    IN_HAND = "in hand"
    """Nothing: the current call of tracking finishes it."""
    FOR_A_KEYFRAME = "for a keyframe"
    """A keyframe that shows its place."""
    LOST = "lost"
    """The next frame with a pose, or so many lost frames that a new sub-map is started."""
    THINNED = "thinned"
    """A keyframe; initialisation continues without this frame."""
    INITIALISING = "initialising"
    """Enough parallax to initialisation's reference, or it is that reference."""
    FOR_A_LAST_LOOK = "for a last look"
    """A replay's end, when every keyframe is known."""
    IN_IDLE_TIME = "in idle time"
    """Idle time of a live run; its keyframe exists."""


class Bound(NamedTuple):
    """How many frames a state may hold, and why the oldest beyond that get no pose."""

    most: int
    reason: str


BOUNDS = {
    Wait.FOR_A_KEYFRAME: Bound(60, "no parallax yet"),
    Wait.THINNED: Bound(600, "no parallax yet"),
    Wait.IN_IDLE_TIME: Bound(120, "no time to look back"),
}
"""Bounds memory while nothing moves, and while a live run has no time. Thinned frames are a minute
of hovering at 10 frames/s, 0.4 GB of pictures at 640 x 360 px; a keyframe there places them all."""


class WaitingFrames:
    """The frames by state, in the order in which they entered it."""

    def __init__(self) -> None:
        self._frames: dict[Wait, dict[int, Frame]] = {state: {} for state in Wait}

    def enter(self, frame: Frame) -> None:
        """Add a frame that tracking starts to process."""
        self._frames[Wait.IN_HAND][frame.index] = frame

    def of(self, state: Wait) -> list[Frame]:
        """The frames in ``state``."""
        return list(self._frames[state].values())

    def count(self, state: Wait) -> int:
        """How many frames are in ``state``."""
        return len(self._frames[state])

    def put(self, frames: Iterable[Frame], state: Wait) -> None:
        """Append frames to ``state``; frames that have left are ignored."""
        for frame in frames:
            held = [each.pop(frame.index, None) for each in self._frames.values()]
            if any(each is not None for each in held):
                self._frames[state][frame.index] = frame

    def move(self, before: Wait, after: Wait) -> list[Frame]:
        """Move all frames of one state into another; returns these frames."""
        frames = self.of(before)
        self.put(frames, after)
        return frames

    def settle(
        self, decided: Iterable[Tracked], as_lost: Callable[[Frame, str], Tracked]
    ) -> list[Tracked]:
        """All frames that leave now, each once: the oldest beyond a bound, those ``decided``, and
        those in hand that are not decided, which are lost."""
        leaving: list[Tracked] = []
        for state, bound in BOUNDS.items():
            surplus = self.of(state)[: max(0, self.count(state) - bound.most)]
            for frame in surplus:
                del self._frames[state][frame.index]
                leaving.append(as_lost(frame, bound.reason))
        in_hand = self._frames[Wait.IN_HAND]
        for tracked in decided:
            if in_hand.pop(tracked.frame.index, None) is not None:
                leaving.append(tracked)
        leaving += [as_lost(frame, "no pose found") for frame in in_hand.values()]
        in_hand.clear()
        return leaving

    def take_all(self) -> list[Frame]:
        """Move all frames in hand; these frames, in the order of their numbers."""
        for state in Wait:
            self.move(state, Wait.IN_HAND)
        return sorted(self.of(Wait.IN_HAND), key=lambda frame: frame.index)
