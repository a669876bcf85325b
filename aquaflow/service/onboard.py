"""``aquaflow run``: a live dive with everything around it."""

from __future__ import annotations

import contextlib
import logging
import threading
from pathlib import Path

from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive_run import Finished
from aquaflow.errors import AquaFlowError
from aquaflow.maps import Progress
from aquaflow.service.choice import Choice, choose, is_unfinished, resumed, tidy
from aquaflow.service.feed import Feed
from aquaflow.service.http import HealthServer
from aquaflow.service.moment import Moment
from aquaflow.service.pose_out import PoseOut, metric_scale
from aquaflow.service.report import report
from aquaflow.service.session import LiveDive
from aquaflow.service.vehicle import VehicleReport
from aquaflow.service.window import LiveWindow

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
    """Map what ``feed`` brings until it ends, ``seconds`` have passed, or somebody says stop.

    Args:
        out: the dive's folder; None: the unfinished dive in ``service.dives``, or a new one there.
        new: begin anew, whatever could be resumed.
        overwrite: a dive that is in ``out`` already.

    Returns None where nothing could be mapped.

    Raises:
        AquaFlowError: the folder, the config, the source or the loop; the checkpoint stays.
    """
    service = vehicle.service
    if out is None:
        choice = choose(service.dives, service.checkpoint, new, Moment.now())
        tidy(service.dives, choice.folder)
    else:
        choice = resumed(out, new)
        overwrite = overwrite or is_unfinished(out)
    with contextlib.ExitStack() as around:
        dive = around.enter_context(_begun(choice, feed, vehicle, new or overwrite, out is None))
        if service.health.enabled:
            server = HealthServer(service.health, lambda: report(dive.parts, service.hang_s))
            around.callback(server.close)
        watchers = dive.parts.loop.watchers
        watchers.append(VehicleReport(service.report, feed).look)
        if service.pose.enabled:
            scale = metric_scale(dive.parts.slam)
            watchers.append(PoseOut(service.pose, feed, scale).look)
        if vehicle.viewer.enabled:
            window = LiveWindow(
                vehicle.viewer, dive.parts.maps, lambda: report(dive.parts, service.hang_s)
            )
            around.callback(window.close)
            watchers.append(window.look)
        around.callback(_stop_after(seconds, dive).cancel)
        return dive.run(progress)


def _begun(
    choice: Choice, feed: Feed, vehicle: VehicleConfig, overwrite: bool, unattended: bool
) -> LiveDive:
    """The dive; where nobody is there to help, one that cannot be resumed gives way to another."""
    try:
        return LiveDive(choice.folder.name, choice, feed, vehicle, overwrite)
    except AquaFlowError as error:
        if choice.checkpoint is None or not unattended:
            raise
        log.error("%s: %s; a new dive begins", choice.folder, error)
        service = vehicle.service
        fresh = choose(service.dives, service.checkpoint, True, Moment.now())
        return LiveDive(fresh.folder.name, fresh, feed, vehicle, overwrite)


def _stop_after(seconds: float | None, dive: LiveDive) -> threading.Timer:
    timer = threading.Timer(seconds or 0.0, dive.parts.loop.stopping.set)
    timer.daemon = True
    if seconds is not None:
        timer.start()
    return timer
