"""Logs that were never synchronised with the video join the dive once its poses are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from aquaflow.config.device import MountingConfig
from aquaflow.dive.run import DiveRun
from aquaflow.sources.telemetry_input import TelemetryInput
from aquaflow.telemetry.start import camera_in_body
from aquaflow.telemetry.time_offset import (
    NotSynchronisedError,
    TimeOffset,
    offset_of_log,
    synchronised,
)
from aquaflow.telemetry.turns import Array, Turns
from aquaflow.tracking.frames import Tracked


def synchronise(run: DiveRun, telemetry: TelemetryInput) -> dict[str, TimeOffset]:
    """Find the offset of every unsynchronised log and hand its samples to the dive; by file name.

    Called after the last frame and before the dive is finished. A log that cannot be used costs
    itself: a note says why.
    """
    found: dict[str, TimeOffset] = {}
    if not telemetry.unsynchronised:
        return found
    run.decide(run.slam.finish_tracking())
    camera, R_cb = turns_of(run.results), _body_to_camera(run.slam.metric.mounting)
    for name, log in telemetry.unsynchronised.items():
        with run.slam.failures.contain("telemetry"):
            samples = list(log.samples())
            try:
                offset = offset_of_log(name, samples, camera, R_cb)
            except NotSynchronisedError as error:
                run.notes.append(str(error))
                continue
            run.notes.append(in_words(name, offset))
            for sample in synchronised(samples, offset):
                run.sample(sample)
            found[name] = offset
    return found


def turns_of(results: Sequence[Tracked]) -> Turns:
    """How the camera turned, within every sub-map."""
    posed = [each for each in results if each.T_wc is not None]
    return Turns.joined(
        [
            _turns_of_sub_map([each for each in posed if each.sub_map == sub_map])
            for sub_map in sorted({each.sub_map for each in posed})
        ]
    )


def _turns_of_sub_map(posed: Sequence[Tracked]) -> Turns:
    in_order = sorted(posed, key=lambda each: each.frame.t_ns)
    t_s = np.array([each.frame.t_ns * 1e-9 for each in in_order])
    R_mc = np.stack([each.T_wc.R for each in in_order if each.T_wc is not None])
    return Turns.of_orientations(t_s, R_mc)


def _body_to_camera(mounting: MountingConfig | None) -> Array | None:
    return None if mounting is None else camera_in_body(mounting).R.T


def in_words(name: str, offset: TimeOffset) -> str:
    """One sentence for the user."""
    slow = f", its clock {1e6 * offset.drift:.0f} ppm slow" if offset.drift else ""
    begins_s = 1e-9 * offset.video_ns(0)
    return (
        f"{name} was synchronised by its rotations: it begins {begins_s:.3f} s after the first "
        f"picture (1 sigma {1e3 * offset.sigma_s:.0f} ms{slow}, correlation "
        f"{offset.correlation:.2f})"
    )
