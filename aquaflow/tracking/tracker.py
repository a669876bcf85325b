"""The frontend: every frame's pose against the latest keyframe, and its class (paper, Sec. 3.2)."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TypeAlias

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.errors.failures import Failures
from aquaflow.base.worker import Worker
from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, KeyframeStore
from aquaflow.prior.contract import Encoding, PairGeometry, Prior
from aquaflow.tracking.consistency import ConsistencyMonitor
from aquaflow.tracking.current_keyframe import CurrentKeyframe, KeyframeTracker
from aquaflow.tracking.frames import (
    FrameClass,
    KeyframeEdge,
    Quality,
    Revisit,
    Step,
    Tracked,
    Wait,
    WaitingFrames,
)
from aquaflow.tracking.initialisation.back_fill import BackFillResult, BackFills
from aquaflow.tracking.initialisation.second_solution import SecondSolution
from aquaflow.tracking.keyframe_reuse import STAGE as RETURN
from aquaflow.tracking.keyframe_reuse import KeyframeReuse, ReuseResult, carry
from aquaflow.tracking.loops import Places
from aquaflow.tracking.map_start import MapStart, NewMap
from aquaflow.tracking.pose.matcher import Matched
from aquaflow.tracking.repairs import LastFrame, Repairs, find_revisit
from aquaflow.types import Frame

log = logging.getLogger(__name__)

ExpectedMotion: TypeAlias = Callable[[Keyframe, int, int, Sim3], Sim3 | None]
"""The camera's motion between two moments (ns) as telemetry has it, in units of the keyframe; the
last argument is the motion between the two frames before."""

LAST_LOOKS = 60
"""Lost frames that a replay looks at again at its end; bounds memory and time, some 2 s each."""
NEAR_IN_TIME = 3
"""Keyframes that such a frame is looked for in."""


class Tracker:
    """One camera, one stream; a loss starts a new sub-map instead of failing."""

    def __init__(
        self,
        prior: Prior,
        keyframes: KeyframeStore,
        config: TrackingConfig,
        places: Places | None = None,
        failures: Failures | None = None,
        motion: ExpectedMotion | None = None,
        worker: Worker | None = None,
    ) -> None:
        """Without ``places`` there is no relocalisation: a lost camera starts a new sub-map.

        Frames that waited for a keyframe get their poses once it is there, or, with a ``worker``
        that is not in step, whenever there is time, by :meth:`back_fill`. The worker, which does
        things at once by default, looks for them, and for an earlier keyframe where one is due.
        What raises is counted in ``failures``. ``motion`` is asked for what gyro and DVL measured
        since the last frame.
        """
        self.sub_map = 0
        self.camera: CameraModel | None = None
        """The camera as refined by initialisation, once known."""
        self.focal_sigma = 0.0
        self._prior, self._keyframes, self._config = prior, keyframes, config
        self._places, self._keyframe_tracker = places, KeyframeTracker(prior, keyframes, config)
        self._failures, self._motion = failures or Failures(), motion
        self.sub_maps = 1
        """Number of sub-maps started so far."""
        self._waiting = waiting = WaitingFrames()
        self._worker = worker = worker or Worker(self._failures)
        self._start = MapStart(prior, config, waiting, self._failures, worker.in_step)
        self._back_fills = BackFills(waiting, prior, self._keyframe_tracker, self._failures, worker)
        self._at: CurrentKeyframe | None = None
        self._origin = Sim3.identity()
        self._second: SecondSolution | None = None
        """Of the newest start, until its first keyframe is left."""
        self.monitor = ConsistencyMonitor(self._keyframe_tracker.neighbours, config)
        self._repair = Repairs(self.monitor, self._keyframe_tracker)
        self._returning = KeyframeReuse(self._keyframe_tracker, config, worker, self._failures)
        self._solved: Matched | None = None
        """The last frame at the keyframe in use; None if it has become a keyframe itself."""
        self._joined: set[tuple[int, int]] = set()
        """Pairs of keyframes, the later one first, whose relative pose was noted."""
        self._edges = Step()
        """Links and revisits of the step that is being made."""
        self._reasons: dict[int, str] = {}
        """Why frames that wait for a last look are lost."""
        self._ending = False
        """True once the last frame was tracked: what is lost then leaves."""

    def track(self, frame: Frame) -> Step:
        """Track a frame; no frame is finished by it while it waits, several may be afterwards.

        Every frame leaves once, here, in :meth:`back_fill` or in :meth:`finish`.
        """
        self._waiting.enter(frame)
        return self._step("tracking", frame, lambda: self._track(frame))

    @property
    def past(self) -> Frame | None:
        """The frame that :meth:`back_fill` will finish next."""
        return self._back_fills.next

    def back_fill(self) -> Step:
        """Finish :attr:`past`, with or without a pose; nothing is finished if no frame waits, or
        while it is looked for."""
        return self._step("back-filling", self.past, self._back_fills.step)

    def looked_back(self, found: BackFillResult) -> None:
        """The worker has looked for :attr:`past`, which the next :meth:`back_fill` finishes."""
        self._back_fills.take(found)

    def finish(self, until: Deadline | None = None) -> Step:
        """Finish the waiting frames after a last attempt to pose them, as far as there is time."""
        step = self._step("tracking", None, lambda: self._begin() + self._back_fills.all(until))
        self._ending = True
        last = self._step("last look", None, lambda: self._look_once_more(until))
        return replace(step, frames=step.frames + last.frames)

    def _look_once_more(self, until: Deadline | None) -> list[Tracked]:
        """The frames without a pose, each at the keyframes that are next to it in time, and then at
        one that looks like it: more are known now than when it was lost."""
        frames = self._waiting.take_all()
        if self.camera is None:
            return []
        tracked = []
        for frame in frames:
            if until is not None and until.over:
                break
            with self._failures.contain("last look", frame.index):
                found = self._shown_somewhere(frame, self.camera)
                tracked += [] if found is None else [found]
        return tracked

    def _shown_somewhere(self, frame: Frame, camera: CameraModel) -> Tracked | None:
        encoding = self._prior.encode(frame.image, camera, frame.mask)
        keyframes = self._keyframes.keyframes
        near = sorted(keyframes, key=lambda each: abs(each.frame_index - frame.index))
        looked_at = near[:NEAR_IN_TIME]
        tracked = self._keyframe_tracker.tracked_at(looked_at, frame, encoding, camera)
        if tracked is not None or self._places is None:
            return tracked
        alike = self._places.of_frame(encoding, camera)
        if alike is None or alike.keyframe in looked_at:
            return None
        return self._keyframe_tracker.tracked_at([alike.keyframe], frame, encoding, camera)

    @property
    def lost(self) -> bool:
        """True while the latest frames have no pose against the current keyframe."""
        return self._waiting.count(Wait.LOST) > 0

    def resume(self, camera: CameraModel, focal_sigma: float, sub_maps: int, T_wc: Sim3) -> None:
        """Continue with keyframes of an earlier run: relocalise, and until a known place is found
        grow a new sub-map from ``T_wc``, the last pose."""
        self.camera, self.focal_sigma = camera, focal_sigma
        self.sub_map, self.sub_maps = sub_maps, sub_maps + 1
        self._origin = T_wc

    def recall(self, keyframe: Keyframe) -> None:
        """Register a keyframe of an earlier run for relocalisation."""
        self._keyframe_tracker.register(CurrentKeyframe(keyframe))

    def _step(self, stage: str, frame: Frame | None, decide: Callable[[], list[Tracked]]) -> Step:
        """The frames that leave with what ``decide`` decides, and the edges that it found; where it
        raises, ``frame`` is lost, whatever it came to wait for."""
        decided: list[Tracked] = []
        with self._failures.contain(stage, None if frame is None else frame.index) as run:
            decided = decide()
        if run.failed and frame is not None:
            self._waiting.put([frame], Wait.IN_HAND)
        edges, self._edges = self._edges, Step()
        leaving = self._hold_lost(self._waiting.settle(decided, self._as_lost))
        return replace(edges, frames=[self._correct(each, edges) for each in leaving])

    def _correct(self, tracked: Tracked, edges: Step) -> Tracked:
        """The frame as the depths that this step has changed put it."""
        for depths in edges.new_depths:
            if tracked.T_wc is not None and depths.concerns(tracked):
                T_wk = self._keyframes[depths.keyframe].T_wc
                T_kf = depths.correct(T_wk.inverse() @ tracked.T_wc)
                return replace(tracked, T_wc=(T_wk @ T_kf).if_finite())
        return tracked

    def _hold_lost(self, leaving: list[Tracked]) -> list[Tracked]:
        """Those that leave; in a replay, frames that are lost wait for its end."""
        if self._ending or not self._worker.in_step:
            return leaving
        room = LAST_LOOKS - self._waiting.count(Wait.FOR_A_LAST_LOOK)
        lost = [
            each
            for each in leaving
            if each.frame_class is FrameClass.LOST and not self._failures.reason(each.frame.index)
        ][: max(room, 0)]
        for each in lost:
            self._reasons[each.frame.index] = each.reason
            self._waiting.enter(each.frame)
        self._waiting.put((each.frame for each in lost), Wait.FOR_A_LAST_LOOK)
        waits = {each.frame.index for each in lost}
        return [each for each in leaving if each.frame.index not in waits]

    def _as_lost(self, frame: Frame, reason: str = "no pose found") -> Tracked:
        known = self._failures.reason(frame.index) or self._reasons.get(frame.index)
        return Tracked.as_lost(frame, self.sub_map, known or reason)

    def _track(self, frame: Frame) -> list[Tracked]:
        encoding = self._encode(frame)
        if encoding is None:
            return [self._as_lost(frame)]
        if self._at is None:
            return self._find_again(frame, encoding) or self._initialise(frame, encoding)
        tracked = self._follow(frame, encoding)
        if tracked is not None:
            self._check(frame, encoding)
        found = [tracked] if tracked is not None else self._find_again(frame, encoding)
        if found:
            self._waiting.move(Wait.LOST, Wait.FOR_A_KEYFRAME)
            return [*self._back_fill(), *found]
        self._waiting.put([frame], Wait.LOST)
        if self._waiting.count(Wait.LOST) >= self._config.lost_after:
            return self._start_sub_map()
        return []

    def _encode(self, frame: Frame) -> Encoding | None:
        with self._failures.contain("encoding", frame.index):
            return self._prior.encode(frame.image, self.camera or frame.camera, frame.mask)
        return None

    # --- initialisation -----------------------------------------------------------------------

    def _initialise(self, frame: Frame, encoding: Encoding) -> list[Tracked]:
        matched = self._start.add(frame, encoding)
        started = self._start.begin_learned() if matched else None
        worth_an_attempt = not matched or self._start.ready
        tracked = self._begin(started) if started or worth_an_attempt else []
        if self._at is None:
            # So are frames that cannot be matched: the next reference is another one.
            if not matched or self._start.turned_back:
                self._start.restart(frame, encoding)
            return []
        return tracked if matched else tracked + self._track(frame)

    def _begin(self, started: NewMap | None = None) -> list[Tracked]:
        """Make the first keyframe from the initial geometry, and pose the frames that waited."""
        started = started or self._start.solve()
        if started is None:
            return []
        if self.camera is None:
            self.camera, self.focal_sigma = started.camera, started.focal_sigma
        first, encoding, pointmap = started.reference, started.encoding, started.pointmap
        new = self._keyframe_tracker.at_new_keyframe
        at = self._at = new(first, encoding, self._origin, pointmap, self.sub_map)
        self._second = SecondSolution(at.keyframe, self._config)
        tracked = [at.tracked_result(first, FrameClass.KEYFRAME, Quality(), pointmap.copy())]
        at.T_fk = started.T_waiting
        tracked += self._back_fill()
        for posed in started.posed:
            on_reference = self._at is at
            if on_reference and posed.T_fk is not None:
                at.motion = posed.T_fk @ at.T_fk.inverse()
            encoded, result = self._encode(posed.frame), None
            if encoded is not None:
                result = self._follow(posed.frame, encoded, posed.pair if on_reference else None)
            tracked.append(result or self._as_lost(posed.frame))
        return tracked

    def _back_fill(self) -> list[Tracked]:
        """Poses of frames that waited for a keyframe, against the current one."""
        assert self._at is not None
        assert self.camera is not None
        return self._back_fills.start(self._at, self.camera)

    # --- consistency ---------------------------------------------------------------------------

    def _check(self, frame: Frame, encoding: Encoding) -> None:
        """Ask the monitor, and repair what it finds; the last frame keeps its pose."""
        at, camera, solved = self._at, self.camera, self._solved
        if at is None or camera is None:
            return
        with self._failures.contain("consistency monitor", frame.index):
            finding = self.monitor.after(at.keyframe, frame.index, solved, camera)
            if finding is None or solved is None:
                return
            log.warning("frame %d: %s", frame.index, finding)
            repaired = self._repair(finding, at, LastFrame(encoding, camera, solved))
            if repaired is not None:
                self._at = repaired.at
                self._note(repaired.revisit)

    # --- return to a keyframe -----------------------------------------------------------------

    def _becomes_keyframe(
        self,
        frame: Frame,
        at: CurrentKeyframe,
        solved: Matched,
        encoding: Encoding,
        camera: CameraModel,
    ) -> bool:
        """Whether a frame at which a keyframe is due becomes one. An earlier one that the worker
        finds at once is taken up here."""
        due = self._returning.due(frame.index, at, solved, encoding, camera)
        if isinstance(due, bool):
            return due
        look = partial(self._returning.search, due)
        for found in self._worker.ask(RETURN, frame.index, look):
            with self._failures.contain(RETURN, frame.index):
                self._note(self.return_to(found))
        return self._returning.was_in_vain(at)

    def return_to(self, found: ReuseResult) -> Revisit | None:
        """Go on at an earlier keyframe that shows the frame of a look, unless tracking has left
        the one that was in use then; what that says of the two keyframes."""
        look, at = found.look, found.look.at
        if found.back is None:
            self._returning.stay(look)
            return None
        if self._at is not at:
            return None
        back, solved_back = found.back
        self._keyframe_tracker.take_up(back)
        self._keyframe_tracker.register(at)
        revisit = self._join(at, look.solved, back, solved_back, look.camera)
        moved_on = at.T_fk is not look.T_fk
        if moved_on:
            carry(back, look)
        self._at, self._solved = back, None if moved_on else solved_back
        return revisit

    def _note(self, revisit: Revisit | None) -> None:
        if revisit is not None:
            self._edges.revisits.append(revisit)

    def _join(
        self,
        at: CurrentKeyframe,
        solved: Matched,
        back: CurrentKeyframe,
        solved_back: Matched,
        camera: CameraModel,
    ) -> Revisit | None:
        """What the last frame, placed at both, says of two keyframes; once for a pair."""
        numbers = at.keyframe.number, back.keyframe.number
        pair = (max(numbers), min(numbers))
        if pair[0] == pair[1] or pair in self._joined:
            return None
        self._joined.add(pair)
        pointmap, _ = self._keyframe_tracker.pointmap(at, solved, camera)
        return find_revisit(at, solved, back, solved_back, pointmap)

    def _solve_again(
        self,
        second: SecondSolution,
        frame: Frame,
        at: CurrentKeyframe,
        solved: Matched,
        camera: CameraModel,
    ) -> Matched:
        """The map's first keyframe is left: its second solution, and the frame's pose with it."""
        self._second = None
        with self._failures.contain("second solution", frame.index):
            depths = second.solve(frame.index)
            if depths is not None:
                self._edges.new_depths.append(depths)
                return self._keyframe_tracker.solve_again(at, solved, camera)
        return solved

    # --- loss -----------------------------------------------------------------------------------

    def _start_sub_map(self) -> list[Tracked]:
        """Give the lost frames to a new sub-map that starts where the old one ended."""
        assert self._at is not None
        self._origin = self._at.T_wc
        self.sub_map, self.sub_maps = self.sub_maps, self.sub_maps + 1
        self._keyframe_tracker.register(self._at)
        self._at = None
        lost = self._waiting.move(Wait.LOST, Wait.IN_HAND)
        return [tracked for frame in lost for tracked in self._track(frame)]

    def _find_again(self, frame: Frame, encoding: Encoding) -> list[Tracked]:
        """Continue at an earlier keyframe that shows the lost frame's place; nothing if none does.

        Frames that waited for a new sub-map get their poses there too, where they can.
        """
        if self._places is None or self.camera is None:
            return []
        before, there = self._at, None
        with self._failures.contain("relocalisation", frame.index):
            there = self._keyframe_tracker.recent(before, encoding, self.camera)
            found = None if there else self._places.of_frame(encoding, self.camera)
            if found is not None:
                keyframe = self._keyframes.load(found.keyframe.number)
                there = CurrentKeyframe(keyframe, T_fk=found.estimate.T)
        if there is None:
            return []
        self._at = there
        tracked = self._follow(frame, encoding)
        if tracked is None:
            self._at = before
            if before is not None:
                self._keyframes.load(before.keyframe.number)
            return []
        if before is not None:
            self._keyframe_tracker.register(before)
        self._start.end()
        return [*self._back_fill(), tracked]

    # --- following a keyframe -----------------------------------------------------------------

    def _follow(
        self, frame: Frame, encoding: Encoding, pair: PairGeometry | None = None
    ) -> Tracked | None:
        """Pose, fusion and class of one frame; None if no pose is found."""
        with self._failures.contain("pose", frame.index):
            return self._place(frame, encoding, pair)
        return None

    def _expect(self, at: CurrentKeyframe, frame: Frame) -> None:
        """Set the motion that is expected since the last frame."""
        motion = None
        if self._motion is not None and at.t_ns > 0:
            with self._failures.contain("expected motion", frame.index):
                motion = self._motion(at.keyframe, at.t_ns, frame.t_ns, at.motion)
        at.expect(frame.t_ns, motion)

    def _place(self, frame: Frame, encoding: Encoding, pair: PairGeometry | None) -> Tracked | None:
        assert self._at is not None
        assert self.camera is not None
        at, camera, keyframe_tracker = self._at, self.camera, self._keyframe_tracker
        self._solved = None
        self._expect(at, frame)
        solved = keyframe_tracker.place(at, encoding, camera, pair)
        solved = keyframe_tracker.place_after_turn(at, encoding, camera, solved)
        if solved is None:
            return None
        keyframe_tracker.take(at, solved, camera)
        second = self._second if self._second and self._second.keyframe is at.keyframe else None
        if second is not None and not keyframe_tracker.is_hidden(solved):
            second.take(solved)
        at.t_ns = frame.t_ns
        if keyframe_tracker.is_hidden(solved):
            frame = keyframe_tracker.without_hidden(frame, at, solved, camera)
        frame_class = keyframe_tracker.classify(at, solved, camera)
        self._solved = solved
        if frame_class is FrameClass.KEYFRAME:
            due = self._becomes_keyframe(frame, at, solved, encoding, camera)
            frame_class = FrameClass.KEYFRAME if due else FrameClass.COMMON
        if frame_class is FrameClass.COMMON:
            return self._at.tracked_result(frame, frame_class, self._solved.quality)
        if second is not None and frame_class is FrameClass.KEYFRAME:
            solved = self._solve_again(second, frame, at, solved, camera)
        pointmap, depth = keyframe_tracker.pointmap(at, solved, camera)
        if depth is not None:
            frame, pointmap = keyframe_tracker.without_moving(frame, at, solved, pointmap, depth)
        if frame_class is FrameClass.MAPPING:
            at.mapped_parallax_px = solved.parallax_px
            return at.tracked_result(frame, frame_class, solved.quality, pointmap.copy())
        estimate = solved.estimate
        link = KeyframeEdge(at.keyframe.number, estimate.T, estimate.covariance, solved.pair)
        self.sub_map = at.keyframe.sub_map
        keyframe_tracker.register(at)
        self._solved = None
        self._joined.add((len(self._keyframes), at.keyframe.number))
        new = keyframe_tracker.at_new_keyframe
        self._at = new(frame, encoding, at.T_wc, pointmap, self.sub_map, at.motion)
        self._at.interval_ns = at.interval_ns
        self._edges.links[self._at.keyframe.number] = link
        return self._at.tracked_result(frame, frame_class, solved.quality, pointmap.copy())
