"""``aquaflow run``: a live dive with its viewer, health server and vehicle messages."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive.run import Finished
from aquaflow.errors import AquaFlowError
from aquaflow.mapping.maps import Progress
from aquaflow.service.checkpoint.checkpoint import UnusableStateError
from aquaflow.service.checkpoint.resume import Choice, choose, is_begun, resumed, tidy
from aquaflow.service.checkpoint.set_aside import SetAside
from aquaflow.service.feed import Feed
from aquaflow.service.health.http import HealthServer
from aquaflow.service.live_dive import LiveDive
from aquaflow.service.live_viewer import LiveViewer
from aquaflow.service.moment import Moment
from aquaflow.service.report import report
from aquaflow.service.vehicle.pilot_messages import PilotMessages
from aquaflow.service.vehicle.pose_output import PoseOutput
from aquaflow.service.vehicle.scale_sources import refuse_without_scale

log = logging.getLogger(__name__)


def map_live(
    feed: Feed,
    vehicle: VehicleConfig,
    out: Path | None = None,
    new: bool = False,
    seconds: float | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> Finished | None:
    """Map what ``feed`` brings until it ends, ``seconds`` have passed, or it is stopped.

    Args:
        out: the dive's folder, or a new one next to it if it holds another dive; None: the
            unfinished dive in ``service.dives``, or a new one there.
        new: start a new dive even if one could be resumed.
        overwrite: a dive that is in ``out`` already, instead of going on with it.

    Returns None where nothing could be mapped.

    Raises:
        AquaFlowError: the folder, the config, the source or the loop; the checkpoint stays.
    """
    service = vehicle.service
    if service.pose.enabled:
        refuse_without_scale(vehicle)
    with contextlib.ExitStack() as around:
        dive = around.enter_context(begun(feed, vehicle, out, new, overwrite))
        slam = dive.parts.slam
        poses = PoseOutput(service.pose, feed, slam.metric_frame) if service.pose.enabled else None
        say = partial(report, dive.parts, service.hang_s, poses)
        if service.health.enabled:
            server = HealthServer(service.health, say)
            around.callback(partial(_closed, dive, server.close))
        watchers = dive.parts.loop.watchers
        watchers.append(PilotMessages(service.report, feed).update)
        if poses is not None:
            watchers.append(poses.update)
        if vehicle.viewer.enabled:
            viewer = LiveViewer(vehicle.viewer, dive.parts.maps, say)
            around.callback(partial(_closed, dive, viewer.close))
            watchers.append(viewer.update)
        around.callback(_stop_after(seconds, dive).cancel)
        return dive.run(progress)


def begun(
    feed: Feed, vehicle: VehicleConfig, out: Path | None, new: bool, overwrite: bool
) -> LiveDive:
    """The dive of :func:`map_live`, before its first frame. If a checkpoint cannot be resumed, the
    one before is used, and then a new dive; in an unattended run also if the config does not fit.

    Raises:
        AquaFlowError: the folder, or the config.
    """
    while True:
        choice = _chosen(vehicle, out, new, overwrite)
        replaces = overwrite or is_begun(choice.folder)
        try:
            return LiveDive(choice.folder.name, choice, feed, vehicle, replaces)
        except UnusableStateError as error:
            assert choice.checkpoint is not None
            log.error("%s", error)
            SetAside(choice.folder).move(choice.checkpoint.file, str(error))
        except AquaFlowError as error:
            if choice.checkpoint is None or out is not None:
                raise
            log.error("%s: %s; a new dive begins", choice.folder, error)
            new = True


def _chosen(vehicle: VehicleConfig, out: Path | None, new: bool, overwrite: bool) -> Choice:
    if out is not None:
        return Choice(out) if overwrite else resumed(out, new)
    service = vehicle.service
    choice = choose(service.dives, service.checkpoint, new, Moment.now())
    tidy(service.dives, choice.folder)
    return choice


def _closed(dive: LiveDive, close: Callable[[], None]) -> None:
    with dive.parts.slam.failures.contain("closing"):
        close()


def _stop_after(seconds: float | None, dive: LiveDive) -> threading.Timer:
    timer = threading.Timer(seconds or 0.0, dive.parts.loop.stopping.set)
    timer.daemon = True
    if seconds is not None:
        timer.start()
    return timer
