"""Return to an earlier keyframe instead of making a new one.

To look for one costs as much as tracking two or three frames, so it is side work: in a live run the
answer comes some frames later, and until then no keyframe is made.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from aquaflow.base.errors.failures import Failures
from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.prior.contract import Encoding
from aquaflow.tracking.current_keyframe import CurrentKeyframe, KeyframeTracker
from aquaflow.tracking.loops.neighbours import Neighbour
from aquaflow.tracking.pose.expected_matches import expected_matches
from aquaflow.tracking.pose.matcher import Matched
from aquaflow.tracking.side_work import SideWork

STAGE = "return to a keyframe"
"""Name of this side work."""


@dataclass(frozen=True)
class Look:
    """A frame at which a keyframe is due, and the earlier ones that may show it."""

    frame: int
    t_ns: int
    at: CurrentKeyframe
    """In use; later frames move it on."""
    T_fk: Sim3
    """Pose of the frame there."""
    solved: Matched
    encoding: Encoding
    camera: CameraModel
    around: Sequence[Neighbour]


Take = Callable[[Look, CurrentKeyframe, Matched], None]
"""Gets an earlier keyframe that shows the frame of a look, and the frame's pose there."""


class Returning:
    """Decides whether a frame at which a keyframe is due becomes one."""

    def __init__(
        self,
        keyframe_tracker: KeyframeTracker,
        config: TrackingConfig,
        side_work: SideWork,
        failures: Failures,
        take: Take,
    ) -> None:
        self._keyframe_tracker, self._config = keyframe_tracker, config
        self._side_work, self._failures, self._take = side_work, failures, take
        self._looked_for: CurrentKeyframe | None = None
        """The keyframe in use for which an earlier one was looked for last."""
        self._in_vain: CurrentKeyframe | None = None
        """The one for which that has just been found out not to be there."""

    def does(
        self,
        frame: int,
        at: CurrentKeyframe,
        solved: Matched,
        encoding: Encoding,
        camera: CameraModel,
    ) -> bool:
        """True if no new keyframe is made: an earlier one shows the frame well, or, in a place that
        has keyframes enough, the one in use does; or that is not known yet.

        Only one that agrees with the keyframe in use about where the frame is: of a place that the
        graph does not know to be the same, a new keyframe closes the loop.
        """
        if self._looked_for is at and self._side_work.awaits(STAGE):
            return True
        if self._was_in_vain(at):
            return False
        if self._looked_already(at, solved):
            self._keyframe_tracker.leave(at)
            return True
        neighbours = self._keyframe_tracker.neighbours
        around = neighbours.around(at.T_wc, camera, at.keyframe.sub_map, at.keyframe)
        if not around:
            return False
        self._looked_for = at
        look = Look(frame, at.t_ns, at, at.T_fk, solved, encoding, camera, around)
        found, answer = partial(self._found, look), partial(self._answer, look)
        self._side_work.do(STAGE, frame, found, answer)
        return not self._was_in_vain(at)

    def _was_in_vain(self, at: CurrentKeyframe) -> bool:
        in_vain, self._in_vain = self._in_vain, None
        return in_vain is at

    def _looked_already(self, at: CurrentKeyframe, solved: Matched) -> bool:
        """True if no other keyframe showed more a moment ago."""
        if at.kept is None:
            return False
        since_ns, share = at.t_ns - at.kept[0], at.kept[1]
        config = self._config
        return (
            since_ns < 1e9 * config.crowd_look_s
            and solved.share > share - config.crowd_look_loss
            and solved.share >= config.crowd_share
        )

    def _found(self, look: Look) -> tuple[CurrentKeyframe, Matched] | None:
        """The keyframe that shows the frame best, if one does well enough; in any thread."""
        config, best = self._config, None
        least = look.solved.share if self._is_crowded(look) else config.return_share
        with self._failures.contain(STAGE, look.frame):
            for neighbour in look.around[: config.return_candidates]:
                back = self._keyframe_tracker.back_at(
                    neighbour, look.at, look.encoding, look.camera
                )
                if back is not None and back[1].share >= least:
                    best, least = back, back[1].share
                if least >= config.return_share:
                    break
        return best

    def _answer(self, look: Look, best: tuple[CurrentKeyframe, Matched] | None) -> None:
        if best is not None:
            self._take(look, *best)
        elif self._is_crowded(look) and look.solved.share >= self._config.crowd_share:
            look.at.kept = look.t_ns, look.solved.share
            self._keyframe_tracker.leave(look.at)  # its points are kept, as of one that is left
        else:
            self._in_vain = look.at

    def _is_crowded(self, look: Look) -> bool:
        return len(look.around) >= self._config.crowd


def carry(back: CurrentKeyframe, look: Look) -> None:
    """Move ``back``, at which the frame of ``look`` was placed, on to the last frame."""
    at = look.at
    since = at.T_fk @ look.T_fk.inverse()
    unit = at.keyframe.T_wc.scale / back.keyframe.T_wc.scale
    back.T_fk = Sim3(since.R, unit * since.t) @ back.T_fk
    back.matches = expected_matches(back.keyframe.pointmap, back.T_fk, look.camera)
    back.motion, back.t_ns = at.motion, at.t_ns
