"""A finished dive as one MCAP file of ROS 2 messages, with a layout for Foxglove beside it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow import __version__
from aquaflow.base.errors import InputError, printable
from aquaflow.base.storage.atomic import atomic_write, write_json
from aquaflow.dive.deliverables import (
    FinishedFrame,
    read_finished_frames,
    start_ns,
)
from aquaflow.dive.dive import Dive
from aquaflow.dive.medium import lamp_of
from aquaflow.dive.placement import Placement, placement
from aquaflow.dive.point_cloud import read_point_cloud
from aquaflow.dive.restored import SeenFrame, seen_frames, tone_without_water, without_water
from aquaflow.dive.ros import messages, topics
from aquaflow.dive.ros.topics import (
    ALTITUDE,
    CAMERA,
    CAMERA_INFO,
    DEPTH,
    DIAGNOSTICS,
    HEADING,
    LASTING,
    MAP,
    MESSAGE_ENCODING,
    OPTICAL,
    PATH,
    POINTS,
    POSE,
    QUALITY,
    RENDERED,
    RESTORED,
    SCHEMA_ENCODING,
    SPEED,
    TYPES,
    FrameTree,
    definition,
    encode,
    require_rosbags,
)
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import to_bytes
from aquaflow.render.transfers import picture_out
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.water.tone import ShownTone

Progress = Callable[[int, int], None]

SINCE_START = "seconds since the recording's first frame; no source stated UTC"
UTC = "UTC"
NO_POSE = frozenset({"lost", "dropped"})
"""Classes of frames that should have had a pose."""
NUMBERS = {
    topics.DEPTH: "depth_m",
    topics.ALTITUDE: "altitude_m",
    topics.HEADING: "heading_deg",
    topics.SPEED: "speed_m_s",
}
"""Columns of trajectory.csv that have a topic of their own."""


@dataclass(frozen=True)
class McapExport:
    """What was written."""

    layout: Path
    messages: int
    poses: int
    pictures: int
    points_step: int
    """Of how many points of the map in a row one is in the file."""
    times: str
    where: Placement


class _Source:
    """What the parts of the file are made from."""

    def __init__(self, dive: Dive, recording: Path | None) -> None:
        self.dive, self.recording = dive, recording
        self.frames = read_finished_frames(dive)
        self.frame = dive.frame
        self.where = placement(self.frame)
        self.tree = FrameTree(self.frame, self.where)
        self.mapper: Mapper = dive.map()
        start = start_ns(dive.metrics)
        self.times = SINCE_START if start is None else UTC
        self._start_ns = start or 0
        self.posed = [frame for frame in self.frames if frame.T_nc is not None]
        if not self.posed:
            raise InputError(f"{dive} has no pose in its largest sub-map; map the dive again")

    @property
    def has_water(self) -> bool:
        return bool(self.mapper.medium.active)

    def at(self, frame: FinishedFrame) -> int:
        """The time of a message, ns."""
        return self._start_ns + frame.t_ns


def export_mcap(
    dive: Dive, path: Path, recording: Path | None = None, progress: Progress | None = None
) -> McapExport:
    """Write the largest sub-map of ``dive`` to ``path``, and ``NAME.layout.json`` beside it.

    The camera's pictures are in it with the ``recording``; what the map shows, and where there is
    water the restored pictures, always. Message times are the dive's: see docs/formats.md#ros.

    Raises:
        InputError: the dive has no map or no pose, the recording is another, a library is missing,
            or a file cannot be written.
        ConfigError: the dive's settings cannot be read.
    """
    source = _Source(dive, recording)
    shown = 0
    with ros_file(path, _facts(source)) as file:
        seen = _Pictures(source, progress)
        first = source.at(source.frames[0])
        step = _write_lasting(file, source, first)
        for frame in source.frames:
            _write_frame(file, source, frame)
            shown += seen.write(file, frame)
        count = file.count
        beside = path.with_suffix(".layout.json")  # first: where the messages are, all is
        write_json(beside, layout(*pictures(recording is not None, source.has_water)))
    return McapExport(beside, count, len(source.posed), shown, step, source.times, source.where)


def _facts(source: _Source) -> dict[str, str]:
    """The metadata record of the file."""
    return {
        "version": __version__,
        "dive": printable(source.dive.path.name),
        "unit": source.where.unit,
        "map": source.where.in_words() if source.where.epsg is None else source.where.axes,
        "times": source.times,
    }


def _write_lasting(file: RosFile, source: _Source, t_ns: int) -> int:
    """What holds for the whole dive, at its beginning, so that it is seen from there on; returns of
    how many points in a row one was written."""
    tree, where = source.tree, source.where
    file.write(topics.TF_STATIC, t_ns, messages.transforms(t_ns, tree.fixed))
    poses = [(source.at(f), tree.moving(f.T_nc).T) for f in source.posed if f.T_nc is not None]
    file.write(topics.PATH, t_ns, messages.path(t_ns, MAP, poses))
    cloud = read_point_cloud(source.dive)
    points = messages.packed_points(cloud)
    file.write(topics.POINTS, t_ns, messages.point_cloud(t_ns, MAP, points))
    warnings = source.dive.metrics.get("warnings", [])
    level = messages.WARN if warnings else messages.OK
    said = "; ".join(warnings) or "no warnings"
    lengths = {"unit": where.unit, "scale": source.frame.scale_source, "x of n": source.frame.north}
    statuses = [
        messages.status(level, "aquaflow: dive", said, {**lengths, "times": source.times}),
        _water_status(source.dive.medium_facts),
    ]
    file.write(topics.DIAGNOSTICS, t_ns, messages.diagnostics(t_ns, statuses))
    return messages.points_step(cloud)


def _water_status(medium: dict[str, Any]) -> Any:
    name = "aquaflow: water"
    if not medium.get("active"):
        return messages.status(messages.OK, name, "no water is modelled", {})
    unit = medium["attenuation_unit"]
    values: dict[str, object] = {}
    rates = {"attenuation": medium["attenuation_per_unit"], **medium["backscatter"]}
    for key, numbers in rates.items():
        per = "" if key.startswith("B_") else f", {unit}"
        for channel, value in zip(messages.CHANNELS, numbers, strict=True):
            values[f"{key} {channel}{per}"] = f"{value:.6g}"
    values |= messages.lamp_values(lamp_of(medium), unit.removeprefix("1/"))
    return messages.status(messages.OK, name, "parameters of the image formation", values)


def _write_frame(file: RosFile, source: _Source, frame: FinishedFrame) -> None:
    """Tracking state of one frame, and its pose."""
    t_ns, row = source.at(frame), frame.row
    level = messages.WARN if row.frame_class in NO_POSE else messages.OK
    values = {
        "frame": row.index, "source": row.source,
        "sub-map": "" if row.sub_map is None else row.sub_map,
        "inlier share": "" if row.quality is None else row.quality,
    }  # fmt: skip
    said = f"{row.frame_class}: {row.reason}" if row.reason else row.frame_class
    status = messages.status(level, "aquaflow: tracking", said, values)
    file.write(topics.DIAGNOSTICS, t_ns, messages.diagnostics(t_ns, [status]))
    if frame.T_nc is None:
        return
    link = source.tree.moving(frame.T_nc)
    file.write(topics.TF, t_ns, messages.transforms(t_ns, [link]))
    file.write(topics.POSE, t_ns, messages.pose(t_ns, link, *_sigmas(frame, source.frame)))
    if row.quality is not None:
        file.write(topics.QUALITY, t_ns, messages.number(row.quality))
    known = frame.known
    for topic, column in NUMBERS.items() if known is not None else ():
        value = getattr(known, column)
        if value is not None:
            file.write(topic, t_ns, messages.number(value))
    if known is not None and known.latitude_deg is not None and known.longitude_deg is not None:
        fix = messages.fix(t_ns, OPTICAL, known.latitude_deg, known.longitude_deg)
        file.write(topics.FIX, t_ns, fix)


def _sigmas(
    finished: FinishedFrame, frame: WorldFrame
) -> tuple[float | None, float | None, float | None]:
    """Of a pose: position (m), heading and tilt (rad)."""
    known = finished.known
    if known is None or known.sigma_position_m is None or known.sigma_heading_deg is None:
        return None, None, None
    heading = float(np.radians(known.sigma_heading_deg))
    return known.sigma_position_m, heading, frame.tilt_sigma_rad


class _Pictures:
    """The pictures of the mapped frames, made as the frames come by."""

    def __init__(self, source: _Source, progress: Progress | None) -> None:
        mapper = source.mapper
        self._source, self._progress, self._done = source, progress, 0
        self._tone = tone_without_water(source.dive, mapper) if source.has_water else ShownTone()
        self._seen: Iterator[SeenFrame] = seen_frames(source.dive, mapper, source.recording)
        self._next = next(self._seen, None)

    def write(self, file: RosFile, frame: FinishedFrame) -> int:
        """The pictures of ``frame``; how many."""
        seen, source = self._next, self._source
        if seen is None or seen.view.frame_index != frame.row.index:
            return 0
        t_ns = source.at(frame)
        info = messages.camera_info(t_ns, OPTICAL, seen.view.camera)
        file.write(topics.CAMERA_INFO, t_ns, info)
        shown = {topics.RENDERED: to_bytes(picture_out(seen.shown.image))}
        if seen.picture is not None:
            shown[topics.CAMERA] = seen.picture
        if source.has_water:
            restored = without_water(source.mapper, seen).picture_bytes(self._tone)
            shown[topics.RESTORED] = restored[..., :3]
        for topic, picture in shown.items():
            file.write(topic, t_ns, messages.jpeg(t_ns, OPTICAL, picture))
        self._next = next(self._seen, None)
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, len(source.mapper.views))
        return len(shown)


# --------------------------------------------------------------------------------------------------
# An MCAP file of ROS 2 messages, as ``ros2 bag`` writes and plays it, and Foxglove opens it.

LIBRARY = "aquaflow"
"""Who wrote the file, in its header."""
QOS = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: {durability}\n"
    "  deadline:\n    sec: 0\n    nsec: 0\n  lifespan:\n    sec: 0\n    nsec: 0\n"
    "  liveliness: 1\n  liveliness_lease_duration:\n    sec: 0\n    nsec: 0\n"
    "  avoid_ros_namespace_conventions: false\n"
)
"""Quality of service by ROS's numbers, as rosbag2 keeps it: reliable; durability 1 is transient
local, 2 volatile."""


class RosFile:
    """Appends messages; channels and schemas are written when first used."""

    def __init__(self, writer: Any) -> None:
        """``writer`` is one of mcap's that was started."""
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.count = 0
        """Messages so far."""

    def write(self, topic: str, t_ns: int, message: Any) -> None:
        """Append a message of ``topic``, which happened at ``t_ns``."""
        if topic not in self._channels:
            name = TYPES[topic]
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(
                    name, SCHEMA_ENCODING, definition(name)
                )
            qos = QOS.format(durability=1 if topic in LASTING else 2)
            self._channels[topic] = self._writer.register_channel(
                topic, MESSAGE_ENCODING, self._schemas[name], {"offered_qos_profiles": qos}
            )
        self._writer.add_message(self._channels[topic], t_ns, encode(message), t_ns, self.count)
        self.count += 1


@contextlib.contextmanager
def ros_file(path: Path, facts: Mapping[str, str]) -> Iterator[RosFile]:
    """A file that is there, whole, once the block ends without an exception; ``facts`` are said of
    it in a metadata record named ``aquaflow``.

    Raises:
        InputError: a library is missing, or the file cannot be written.
    """
    require_rosbags()
    if find_spec("mcap") is None:
        raise InputError("MCAP files need mcap; install it: pip install 'aquaflow[recording]'")
    from mcap.writer import CompressionType, Writer

    with atomic_write(path) as stream:
        writer: Any = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library=LIBRARY)
        writer.add_metadata(LIBRARY, dict(facts))
        yield RosFile(writer)
        writer.finish()


# --------------------------------------------------------------------------------------------------
# The layout that Foxglove and Lichtblick show a dive with: map and path, pictures, plots.

COLOURS = ("#4e98e2", "#f5774d", "#f7df71", "#5cd6a9")
"""Of the lines of a plot, one after the other."""


def layout(picture: str, beside: str) -> dict[str, Any]:
    """The layout as JSON; ``picture`` and ``beside`` are the topics of its two pictures."""
    panels = {
        "3D!map": _scene(),
        "Image!picture": _image(picture),
        "Image!beside": _image(beside),
        "Plot!place": _plot([DEPTH, ALTITUDE, SPEED]),
        "Plot!heading": _plot([HEADING]),
        "Plot!quality": _plot([QUALITY]),
        "DiagnosticSummary!states": {"topicToRender": DIAGNOSTICS, "sortByLevel": True},
    }
    right = _column(["Image!picture", "Image!beside"])
    below = _row(["Plot!place", "Plot!heading", "Plot!quality", "DiagnosticSummary!states"])
    above = {"first": "3D!map", "second": right, "direction": "row", "splitPercentage": 60}
    whole = {"first": above, "second": below, "direction": "column", "splitPercentage": 70}
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": whole,
    }


def pictures(recorded: bool, has_water: bool) -> tuple[str, str]:
    """The two topics to show: what the dive has of camera, render and restored picture."""
    first = CAMERA if recorded else RENDERED
    return first, RESTORED if has_water else RENDERED


def _scene() -> dict[str, Any]:
    """The map and the path from above and aside."""
    return {
        "followTf": MAP,
        "followMode": "follow-none",
        "scene": {"transforms": {"axisScale": 0.3}, "backgroundColor": "#101418"},
        "cameraState": {
            "distance": 12, "phi": 50, "thetaOffset": 45, "fovy": 45, "near": 0.01, "far": 5000,
            "target": [0, 0, 0], "targetOffset": [0, 0, 0], "targetOrientation": [0, 0, 0, 1],
            "perspective": True,
        },
        "topics": {
            POINTS: {"visible": True, "colorField": "rgb", "colorMode": "rgb", "pointSize": 3},
            PATH: {"visible": True, "gradient": ["#5cd6a9ff", "#5cd6a9ff"], "lineWidth": 0.02},
            POSE: {"visible": True, "type": "axis", "axisScale": 0.5, "showCovariance": True},
            CAMERA_INFO: {"visible": True, "distance": 0.5, "width": 0.01},
        },
        "layers": {"grid": {"layerId": "foxglove.Grid", "frameId": MAP, "size": 20}},
    }  # fmt: skip


def _image(topic: str) -> dict[str, Any]:
    return {"imageMode": {"imageTopic": topic, "calibrationTopic": CAMERA_INFO}}


def _plot(topics: list[str]) -> dict[str, Any]:
    lines = [
        {
            "value": f"{topic}.data", "label": topic.rpartition("/")[2], "enabled": True,
            "timestampMethod": "receiveTime", "color": COLOURS[number % len(COLOURS)],
        }
        for number, topic in enumerate(topics)
    ]  # fmt: skip
    return {
        "paths": lines, "showLegend": True, "legendDisplay": "top", "xAxisVal": "timestamp",
        "showXAxisLabels": True, "showYAxisLabels": True, "isSynced": True,
    }  # fmt: skip


def _column(panels: list[str]) -> dict[str, Any]:
    return {
        "first": panels[0], "second": panels[1], "direction": "column", "splitPercentage": 50
    }  # fmt: skip


def _row(panels: list[str]) -> Any:
    """The panels side by side, each as wide as the others."""
    if len(panels) == 1:
        return panels[0]
    return {
        "first": panels[0], "second": _row(panels[1:]), "direction": "row",
        "splitPercentage": 100 / len(panels),
    }  # fmt: skip
