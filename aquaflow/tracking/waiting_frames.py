"""Unfinished frames of tracking: each is in one state, and leaves once.

A state holds no more than a bound: ``initialising`` thins out beyond
``tracking.initialisation.max_waiting``, ``lost`` frames begin a new sub-map at
``tracking.lost_after``, and where frames wait without an end the oldest leave without a pose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import Enum
from typing import NamedTuple

from aquaflow.tracking.frames import Tracked
from aquaflow.types import Frame


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
