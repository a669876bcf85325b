"""Every fault against every live camera: nothing hangs, every picture is counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aquaflow.drivers.live import MAX_LATENCY_NS, CameraState
from aquaflow.sim_drivers.camera_feed import CameraFaults, first_images
from aquaflow.types import Dropped, Frame
from tests.drivers.camera_scenes import COUNT, KINDS, Pictures, live, settled, until

every_kind = pytest.mark.parametrize("kind", KINDS)

STREAMS = ("stream", "rtp")
"""What FFmpeg reads: an index counts from where it joined, and lost pictures leave no gap."""
TELLING = [kind for kind in KINDS if kind not in STREAMS]
"""Cameras that tell the number of a picture, and when it was taken."""


def increasing(values: list[int]) -> bool:
    return bool(np.all(np.diff(values) > 0))


@every_kind
def test_without_faults_every_picture_comes_or_is_counted(kind: str, tmp_path: Path) -> None:
    with live(kind, CameraFaults(), tmp_path) as camera:
        seen = until(camera, 20)
    assert settled(camera)
    n = camera.counters
    assert (n.lost, n.unusable, n.duplicates, n.reconnects, n.stamps_repaired) == (0, 0, 0, 0, 0)
    assert all(isinstance(frame, Frame) for frame in seen)
    assert increasing([frame.index for frame in seen])
    assert camera.state is CameraState.CLOSED


@every_kind
def test_pictures_are_those_of_the_recording(kind: str, tmp_path: Path) -> None:
    with live(kind, CameraFaults(), tmp_path, fps=50.0) as camera:
        seen = until(camera, 10)
    filmed = [image.astype(int) for image in first_images(Pictures(), COUNT)]
    for frame in seen:
        assert isinstance(frame, Frame)
        assert frame.image.dtype == np.uint8
        assert frame.image.shape == (48, 64, 3)
        number = frame.index
        if kind in STREAMS:
            number = round(float(frame.image[:, 0].mean()) / 5.0)
        assert np.abs(frame.image.astype(int) - filmed[number]).max() <= 4


@pytest.mark.parametrize("kind", TELLING)
def test_dropped_pictures_are_counted_by_the_gap_that_they_leave(kind: str, tmp_path: Path) -> None:
    faults = CameraFaults(drop=frozenset({3, 4, 9}))
    with live(kind, faults, tmp_path) as camera:
        seen = until(camera, 17)
    assert settled(camera)
    assert camera.counters.lost == 3
    assert not {3, 4, 9} & {frame.index for frame in seen}
    assert increasing([frame.index for frame in seen])


@pytest.mark.parametrize("kind", STREAMS)
def test_a_stream_goes_on_after_pictures_that_never_came(kind: str, tmp_path: Path) -> None:
    with live(kind, CameraFaults(drop=frozenset({3, 4, 9})), tmp_path) as camera:
        until(camera, 15)
    assert settled(camera)
    assert camera.counters.lost == 0


@every_kind
def test_a_duplicate_changes_no_time_and_no_order(kind: str, tmp_path: Path) -> None:
    with live(kind, CameraFaults(duplicate=frozenset({2, 5})), tmp_path) as camera:
        seen = until(camera, 15)
    assert settled(camera)
    assert camera.counters.duplicates == (0 if kind in STREAMS else 2)
    assert increasing([frame.t_ns for frame in seen])
    assert camera.counters.lost == 0


@every_kind
def test_a_delayed_picture_keeps_the_moment_of_its_exposure(kind: str, tmp_path: Path) -> None:
    # FFmpeg needs 0.2 s to open a stream, and five pictures to know the stream's time.
    first = 60 if kind in STREAMS else 12
    # Several: those after a delayed picture follow at once, and a busy machine sees the last only.
    delayed = range(first, first + 61, 30)
    faults = CameraFaults(delay_s=dict.fromkeys(delayed, 0.3))
    with live(kind, faults, tmp_path, fps=50.0) as camera:
        seen = until(camera, delayed[-1] + 8)
    assert settled(camera)
    assert camera.counters.stamps_repaired == 0
    assert increasing([frame.t_ns for frame in seen])
    late = [f.arrival_ns - f.t_ns for f in seen if isinstance(f, Frame)]
    if kind == "stream":
        assert max(late) == 0
    else:
        assert max(late) > 0.1e9


@every_kind
def test_a_damaged_picture_costs_only_itself(kind: str, tmp_path: Path) -> None:
    damaged = frozenset(range(4, 100_000, 3))  # so many that a busy machine does not miss all

    def both_seen(newest: Frame | Dropped) -> bool:
        return isinstance(newest, Frame) and camera.counters.unusable > 0

    with live(kind, CameraFaults(corrupt=damaged), tmp_path, fps=50.0) as camera:
        seen = until(camera, 18, both_seen)
    assert settled(camera)
    assert camera.counters.unusable >= 1
    dropped = [frame for frame in seen if isinstance(frame, Dropped)]
    assert len(dropped) == camera.counters.unusable <= len(damaged)
    assert all(frame.reason.startswith("front#") for frame in dropped)
    assert camera.counters.reconnects == 0
    assert isinstance(seen[-1], Frame)


@every_kind
def test_an_unplugged_camera_comes_back(kind: str, tmp_path: Path) -> None:
    faults = CameraFaults(disconnect=frozenset({6, 13}), away_s=0.1)
    with live(kind, faults, tmp_path) as camera:
        seen = until(camera, 25)
    assert settled(camera)
    # Bare RTP has no connection that could break.
    assert camera.counters.reconnects == (0 if kind == "rtp" else 2)
    assert increasing([frame.index for frame in seen])
    assert increasing([frame.t_ns for frame in seen])


@pytest.mark.parametrize("kind", TELLING)
def test_a_jump_of_the_cameras_clock_is_repaired(kind: str, tmp_path: Path) -> None:
    faults = CameraFaults(clock_jump_s={5: 10.0, 10: -20.0, 15: 10.0})
    with live(kind, faults, tmp_path) as camera:
        seen = until(camera, 20)
    assert settled(camera)
    # On a slow machine also one whose claim lies before the arrival that stands for another's.
    assert camera.counters.stamps_repaired >= 10
    assert increasing([frame.t_ns for frame in seen])
    for frame in seen:
        assert isinstance(frame, Frame)
        assert -1 <= frame.arrival_ns - frame.t_ns < MAX_LATENCY_NS


@every_kind
def test_a_flood_is_overtaken_by_its_newest_picture(kind: str, tmp_path: Path) -> None:
    with live(kind, CameraFaults(flood=range(200, 320)), tmp_path, fps=400.0) as camera:
        frames = camera.frames()
        next(frames)
        while camera.counters.received < 325:  # a consumer that is busy elsewhere
            assert camera.state is not CameraState.CLOSED, "gave up"
            camera._closing.wait(0.02)
        newest = next(frames)
        camera.close()
    assert settled(camera)
    assert camera.counters.overtaken >= 120
    assert newest.index >= 323
