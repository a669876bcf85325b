"""``aquaflow run``: a live dive with everything around it."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path

from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive_run import Finished
from aquaflow.maps import Progress
from aquaflow.service.choice import choose, is_unfinished, resumed, tidy
from aquaflow.service.feed import Feed
from aquaflow.service.http import HealthServer
from aquaflow.service.moment import Moment
from aquaflow.service.pose_out import PoseOut, metric_scale
from aquaflow.service.report import report
from aquaflow.service.session import LiveDive
from aquaflow.service.vehicle import VehicleReport
from aquaflow.service.window import LiveWindow


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
        dive = around.enter_context(
            LiveDive(choice.folder.name, choice, feed, vehicle, overwrite=new or overwrite)
        )
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


def _stop_after(seconds: float | None, dive: LiveDive) -> threading.Timer:
    timer = threading.Timer(seconds or 0.0, dive.parts.loop.stopping.set)
    timer.daemon = True
    if seconds is not None:
        timer.start()
    return timer
