"""Return to an earlier keyframe instead of making a new one.

To look for one costs as much as tracking two or three frames, so a worker does it: on a vehicle the
answer comes some frames later, and until then no keyframe is made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aquaflow.base.errors.failures import Failures
from aquaflow.base.worker import Worker
from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.prior.contract import Encoding
from aquaflow.tracking.current_keyframe import CurrentKeyframe, KeyframeTracker
from aquaflow.tracking.loops import Neighbour
from aquaflow.tracking.pose.matcher import Matched, expected_matches

STAGE = "return to a keyframe"
"""Name of this work."""
CROWD_LOOK_LOSS = 0.05
"""Fall of the matched share from which a crowded place is searched before its time is over."""
APART = 0.5
"""Of the distance between the keyframe in use and the one next to it, how far beyond the one in use
a camera has left them; less lies between keyframes."""
FAR_WIDTHS = 0.03
"""Parallax over the picture's width below which a new keyframe is worse than the one in use: of the
reef backwards it is 0.037 to 0.049; of a net, where matches are lost for other reasons, 0.012 to
0.017 but for once, and of IUI3 0.007 to 0.017."""
RETURN_SHARE = 0.75
"""Matched share from which an earlier keyframe is used again; above ``tracking.keyframe_share``, so
that it is not left at the next frame."""


@dataclass(frozen=True)
class ReuseRequest:
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


@dataclass(frozen=True)
class ReuseResult:
    """What a look found."""

    look: ReuseRequest
    back: tuple[CurrentKeyframe, Matched] | None
    """An earlier keyframe that shows the frame, and the frame's pose there; None: there is none."""


class KeyframeReuse:
    """Decides whether a frame at which a keyframe is due becomes one."""

    def __init__(
        self,
        keyframe_tracker: KeyframeTracker,
        config: TrackingConfig,
        worker: Worker,
        failures: Failures,
    ) -> None:
        self._keyframe_tracker, self._config = keyframe_tracker, config
        self._worker, self._failures = worker, failures
        self._looked_for: CurrentKeyframe | None = None
        """The keyframe in use for which an earlier one was looked for last."""
        self._in_vain: CurrentKeyframe | None = None
        """The one for which that has just been found out not to be there."""

    def due(
        self,
        frame: int,
        at: CurrentKeyframe,
        solved: Matched,
        encoding: Encoding,
        camera: CameraModel,
    ) -> bool | ReuseRequest:
        """False if no new keyframe is made: an earlier one shows the frame well, or, in a place
        that has keyframes enough, the one in use does; or that is not known yet. A look, where it
        is to be found out by :meth:`search`.

        Only one that agrees with the keyframe in use about where the frame is: of a place that the
        graph does not know to be the same, a new keyframe closes the loop.
        """
        if self._looked_for is at and self._worker.waiting(STAGE):
            return False
        if self.was_in_vain(at):
            return True
        if self._looked_already(at, solved):
            self._keyframe_tracker.register(at)
            return False
        neighbours = self._keyframe_tracker.neighbours
        around = neighbours.around(at.T_wc, camera, at.keyframe.sub_map, at.keyframe)
        if not around:
            return True
        self._looked_for = at
        return ReuseRequest(frame, at.t_ns, at, at.T_fk, solved, encoding, camera, around)

    def was_in_vain(self, at: CurrentKeyframe) -> bool:
        """True, once, if no keyframe was found to take the place of the one in use."""
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
            and solved.share > share - CROWD_LOOK_LOSS
            and solved.share >= config.crowd_share
        )

    def search(self, look: ReuseRequest) -> ReuseResult:
        """The keyframe that shows the frame best, if one does well enough; in any thread."""
        config, best = self._config, None
        least = look.solved.share if self._is_crowded(look) else RETURN_SHARE
        with self._failures.contain(STAGE, look.frame):
            for neighbour in look.around[: config.return_candidates]:
                back = self._keyframe_tracker.back_at(
                    neighbour, look.at, look.encoding, look.camera
                )
                if back is not None and back[1].share >= least:
                    best, least = back, back[1].share
                if least >= RETURN_SHARE:
                    break
        return ReuseResult(look, best)

    def stay(self, look: ReuseRequest) -> None:
        """None was found: the keyframe in use is kept in a crowded place, else a new one is due."""
        if self._is_crowded(look) and look.solved.share >= self._config.crowd_share:
            look.at.kept = look.t_ns, look.solved.share
            self._keyframe_tracker.register(look.at)  # its points are kept, as of one that is left
        else:
            self._in_vain = look.at

    def _is_crowded(self, look: ReuseRequest) -> bool:
        return len(look.around) >= self._config.crowd and not leaves(look)


def leaves(look: ReuseRequest) -> bool:
    """True of a camera that goes away from all keyframes of the place: none is as near as the one
    in use, and that is not near either. One that moves backwards has all of them in view for long,
    ever smaller."""
    if look.solved.parallax_px < FAR_WIDTHS * look.camera.width:
        return False
    in_use = look.at.keyframe.T_wc
    here = (in_use @ look.T_fk.inverse()).t
    others = np.stack([neighbour.keyframe.T_wc.t for neighbour in look.around])
    gone = float(np.linalg.norm(here - in_use.t))
    nearest, apart = (float(np.linalg.norm(others - at, axis=1).min()) for at in (here, in_use.t))
    return APART * apart < gone < nearest


def carry(back: CurrentKeyframe, look: ReuseRequest) -> None:
    """Move ``back``, at which the frame of ``look`` was placed, on to the last frame."""
    at = look.at
    since = at.T_fk @ look.T_fk.inverse()
    unit = at.keyframe.T_wc.scale / back.keyframe.T_wc.scale
    back.T_fk = Sim3(since.R, unit * since.t) @ back.T_fk
    back.matches = expected_matches(back.keyframe.pointmap, back.T_fk, look.camera)
    back.motion, back.t_ns, back.interval_ns = at.motion, at.t_ns, at.interval_ns
