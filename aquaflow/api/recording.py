"""Mapping a recording from Python, as ``aquaflow map`` does it on the command line."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aquaflow.config.presets import load_configured
from aquaflow.dive.dive import Dive, read_dive
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.sources import RecordedCamera, open_recording
from aquaflow.sources.telemetry_input import open_telemetry

if TYPE_CHECKING:
    from aquaflow.base.progress import Progress


def map_recording(
    source: str | os.PathLike[str] | RecordedCamera,
    out: str | os.PathLike[str],
    *,
    calibration: str | os.PathLike[str] | CameraModel | None = None,
    config: str | os.PathLike[str] | None = None,
    preset: str | None = None,
    settings: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    telemetry: Sequence[str | os.PathLike[str]] = (),
    telemetry_offset_s: float | None = None,
    in_site: str | os.PathLike[str] | None = None,
    topic: str | None = None,
) -> Dive:
    """Map a recording into the dive folder ``out`` and read what came of it.

    torch, OpenCV and BLAS get the number of threads that the config asks for, in this whole
    process: results repeat bit for bit at a given number.

    Args:
        source: a video, a folder of pictures, an MCAP recording, a ROS bag, a synthetic dive, or
            a camera of your own that is already open.
        out: folder to write; the report and the map files are in it afterwards.
        calibration: a ``camera.yaml`` or the camera itself; else the one that comes with the
            recording, else a guess that is refined.
        config: a YAML file of settings, see ``aquaflow config``.
        preset: ``fast``, ``balanced``, ``accurate`` or ``small``, on top of ``config``.
        settings: single settings on top of both, nested as in the YAML file, such as
            ``{"source": {"every": 2}}``.
        overwrite: replace a dive that ``out`` holds already.
        progress: called with the stage, the steps done and the number of steps (None: unknown);
            the stage ``whole`` counts the seconds of all stages, of which the number is estimated.
        telemetry: logs that were recorded with ``source``, beside the telemetry in it.
        telemetry_offset_s: when these logs begin, s after the first picture; None: it is found
            from the rotations that the logs and the poses have in common.
        in_site: an earlier dive, in whose frame this one goes on once it is recognised there.
        topic: of pictures in a bag or MCAP recording; else the one that suits best.

    Raises:
        InputError: the recording cannot be read or the folder cannot be written.
        ConfigError: a setting is unknown or out of range, or does not fit the pictures.
        NotMappedError: the frames were read but gave no map; the folder says why.
    """
    file = None if config is None else Path(config)
    chosen = load_configured(file, preset, dict(settings or {}), "settings")
    camera = calibration
    if camera is not None and not isinstance(camera, CameraModel):
        camera = load_camera(Path(camera))
    if isinstance(source, (str, os.PathLike)):
        recording = open_recording(Path(source), chosen.source.fps, topic)
        name = Path(source).name
    else:
        recording, name = source, type(source).__name__
    path = Path(source) if isinstance(source, (str, os.PathLike)) else None
    given = open_telemetry(
        path, [Path(log) for log in telemetry], telemetry_offset_s, chosen.source.fps, topic
    )
    from aquaflow.tracking.base import base_of

    base = None if in_site is None else base_of(Path(in_site))
    from aquaflow.dive import replay  # loads torch: after what can be refused without it

    replay.map_recording(
        recording, name, Path(out), chosen, camera, overwrite, progress, telemetry=given,
        base=base, path=path,
    )  # fmt: skip
    return read_dive(out)
