"""Telemetry beside and inside recordings: what a log says, and when."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import StoragePlugin

from tests.recordings.inputs import Dive, Made, made, row, write_plainly
from tests.recordings.inputs.bags import BEGAN_NS, LATE_NS, Messages, pictures_of, write_bag

DEPTHS = [(0.0, 10.0), (0.25, 10.5), (0.5, 11.0), (0.75, 11.5), (1.0, 12.0)]
"""Seconds after the log's beginning, and metres."""
BEGAN = datetime(2024, 5, 1, 23, 59, 59, 500_000, timezone.utc)
"""The day changes within the log."""


def _nmea(text: str) -> str:
    check = 0
    for each in text.encode():
        check ^= each
    return f"${text}*{check:02X}"


def _depth(metres: float) -> str:
    return _nmea(f"SDDBS,,f,{metres:.1f},M,,F")


def _log(
    name: str, file: str, lines: Callable[[], Sequence[str]], *, says: str = "",
    times: Callable[[float], float] = lambda t: t,
) -> None:  # fmt: skip
    """A log beside the pictures, whose samples of depth must have their own times."""

    @row(f"log {name}", near=0.0)
    def _made(dive: Dive, folder: Path) -> Made:
        read = made(dive, folder / "p", camera=dive.camera)
        write_plainly(folder / "p", read, dive.camera)
        (folder / file).write_text("\n".join(lines()) + "\n")
        samples = [(times(t), depth) for t, depth in DEPTHS]
        return replace(read, log=folder / file, samples=samples, log_says=says)


def _utc(t_s: float) -> datetime:
    return BEGAN + timedelta(seconds=t_s)


def _zda(t_s: float) -> str:
    now = _utc(t_s)
    return _nmea(f"GPZDA,{now:%H%M%S}.{now.microsecond // 10_000:02d},{now:%d,%m,%Y},00,00")


_log(
    "NMEA with the UTC of its sentences", "a.nmea", says="the UTC in its sentences is used",
    lines=lambda: [line for t, depth in DEPTHS for line in (_zda(t), _depth(depth))],
)  # fmt: skip
_log(
    "NMEA with stamps since 1970", "a.txt",
    lines=lambda: [f"{_utc(t).timestamp():.3f} {_depth(depth)}" for t, depth in DEPTHS],
)  # fmt: skip
_log(
    "NMEA with ISO dates", "a.nmea",
    lines=lambda: [f"{_utc(t):%Y-%m-%dT%H:%M:%S.%f}Z,{_depth(depth)}" for t, depth in DEPTHS],
)  # fmt: skip
_log(
    "NMEA without any times", "a.nmea", says="10 lines a second are assumed",
    lines=lambda: [_depth(depth) for _, depth in DEPTHS], times=lambda t: 0.4 * t,
)  # fmt: skip
_log(
    "table with seconds", "a.csv",
    lines=lambda: ["t_s,depth_m", *(f"{t},{depth}" for t, depth in DEPTHS)],
)  # fmt: skip
_log(
    "table with UTC", "a.csv",
    lines=lambda: [
        "utc,depth_m", *(f"{_utc(t):%Y-%m-%dT%H:%M:%S.%f}Z,{depth}" for t, depth in DEPTHS)
    ],
)  # fmt: skip


def _bag(
    name: str, ros1: bool, single: bool = False, topic: str | None = None, **options: Any
) -> None:
    """The same depths inside a recording; stamps count, not their reception."""

    @row(f"log in a bag, {name}", near=0.0)
    def _made(dive: Dive, folder: Path) -> Made:
        messages = Messages(ros1)
        pascal = [(t, 101_325.0 + depth * 1029.0 * 9.80665) for t, depth in DEPTHS]
        kind = "sensor_msgs/msg/FluidPressure"
        events = [
            ("/depth", round(t * 1e9),
             messages.make(kind, messages.header(BEGAN_NS + round(t * 1e9)), value, 0.0))
            for t, value in pascal
        ]  # fmt: skip
        path = folder / ("a.bag" if ros1 else "bag")
        events += pictures_of(messages, dive)
        if topic is not None:  # as many pictures of another camera, from a second before on
            events += pictures_of(messages, dive, topic="/a/image_raw", start_ns=-(10**9))
        write_bag(path, messages, events, **options)
        if single:
            (path / "metadata.yaml").unlink()
            (path,) = path.iterdir()
        utc = [(LATE_NS * 1e-9, (BEGAN_NS + LATE_NS) * 1e-9)]
        return made(dive, path, log=path, samples=DEPTHS, utc=utc, topic=topic)


_bag("ROS 1", True)
_bag("ROS 2", False)
_bag("ROS 2 in MCAP", False, storage=StoragePlugin.MCAP)
_bag("a single .db3", False, single=True)
_bag("a single .mcap", False, single=True, storage=StoragePlugin.MCAP)
_bag("ROS 2 with --topic", False, topic="/cam/image_raw")
_bag("a single .mcap with --topic", False, True, "/cam/image_raw", storage=StoragePlugin.MCAP)
