"""What every live camera does by itself: waiting, reconnecting, the newest picture, the end."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.config.cameras import LiveCameraConfig
from aquaflow.drivers.capture import Capture, RawPicture
from aquaflow.drivers.live import CameraState, LiveCamera
from aquaflow.geometry.camera import guess_camera, save_camera
from aquaflow.types import CameraModel, Dropped, Frame
from tests.drivers.camera_scenes import QUICK, closing, settled

SIZE = (32, 24)


class Scripted:
    """A device that hands over what a test wrote down: pictures, None, or an error."""

    notes: tuple[str, ...] = ()
    format = ""

    def __init__(self, *script: RawPicture | Exception | None, camera: CameraModel | None = None):
        self.camera = camera
        self.closed = 0
        self._script = list(script)

    def read(self, timeout_s: float) -> RawPicture | None:
        if not self._script:
            time.sleep(min(timeout_s, 0.01))
            return None
        step = self._script.pop(0)
        if isinstance(step, Exception):
            raise step
        return step

    def close(self) -> None:
        self.closed += 1


def picture(sequence: int | None = None, size: tuple[int, int] = SIZE) -> RawPicture:
    image = np.zeros((size[1], size[0], 3), np.uint8)
    return RawPicture(time.monotonic_ns(), lambda: image, sequence=sequence)


class Silent(Scripted):
    """After its pictures it is silent, for so long each time that it is read."""

    def __init__(self, clock: SimulatedClock, seconds: float, *script: RawPicture):
        super().__init__(*script)
        self._clock, self._seconds = clock, seconds

    def read(self, timeout_s: float) -> RawPicture | None:
        if not self._script:
            self._clock.now_ns += round(self._seconds * 1e9)
        return super().read(timeout_s)


class SimulatedClock:
    """Time that passes when a device lets it."""

    def __init__(self) -> None:
        self.now_ns = time.monotonic_ns()

    def __call__(self) -> int:
        return self.now_ns


def camera(
    *openings: Capture | Exception, clock: SimulatedClock | None = None, **settings: object
) -> LiveCamera:
    """One opening after the other; the last is repeated."""
    queue = list(openings)

    def open_next() -> Capture:
        opening = queue.pop(0) if len(queue) > 1 else queue[0]
        if isinstance(opening, Exception):
            raise opening
        return opening

    config = LiveCameraConfig.model_validate({**QUICK, **settings})
    return LiveCamera("front", config, open_next, clock or time.monotonic_ns)


def paced(count: int, make: Callable[[int], RawPicture]) -> Scripted:
    """``count`` pictures, each only when the one before was taken."""
    taken = threading.Semaphore(1)

    class Paced(Scripted):
        made = 0

        def read(self, timeout_s: float) -> RawPicture | None:
            if self.made == count or not taken.acquire(timeout=timeout_s):
                time.sleep(0.001)
                return None
            shown = make(self.made)
            shown.release = taken.release
            self.made += 1
            return shown

    return Paced()


def test_connecting_to_nothing_is_one_sentence() -> None:
    absent = camera(FileNotFoundError("no camera 'abc'; cameras that may be opened: none"))
    with pytest.raises(InputError, match="camera 'front': no camera 'abc'; cameras that may be"):
        absent.connect()


def test_without_connecting_frames_wait_until_the_device_is_there() -> None:
    absent = FileNotFoundError("not yet")
    with closing(camera(absent, absent, absent, Scripted(picture()))) as late:
        assert isinstance(next(late.frames()), Frame)
        assert late.state is CameraState.STREAMING
        assert late.counters.reconnects == 0


def test_a_device_opened_by_connect_is_the_one_that_streams() -> None:
    device = Scripted(picture())
    with closing(camera(device, RuntimeError("opened twice"))) as once:
        once.connect()
        assert once.state is CameraState.CONNECTING
        next(once.frames())
    assert device.closed == 1


def test_closing_what_was_only_connected_gives_the_device_back() -> None:
    device = Scripted()
    waiting = camera(device)
    waiting.connect()
    waiting.close()
    waiting.close()
    assert device.closed == 1
    assert waiting.state is CameraState.CLOSED


def test_closing_from_another_thread_ends_iteration() -> None:
    with closing(camera(Scripted())) as silent:
        ended = threading.Event()

        def consume() -> None:
            assert list(silent.frames()) == []
            ended.set()

        threading.Thread(target=consume, daemon=True).start()
        assert not ended.wait(0.05)
        silent.close()
        assert ended.wait(10.0)


def test_a_silent_device_is_opened_anew() -> None:
    clock = SimulatedClock()
    silent, good = Silent(clock, 0.3, picture()), Scripted(picture())
    with closing(camera(silent, good, clock=clock, stall_s=1.0)) as stalled:
        frames = stalled.frames()
        assert [next(frames).index, next(frames).index] == [0, 1]
        assert silent.closed == 1
        assert stalled.counters.reconnects == 1


def test_pictures_of_the_past_are_counted_and_show_nothing() -> None:
    def shown(number: int) -> RawPicture:
        return replace(picture(), stale="its pictures are 4.0 s old" if 0 < number < 4 else "")

    with closing(camera(paced(5, shown))) as held:
        frames = held.frames()
        assert [next(frames).index, next(frames).index] == [0, 4]
        assert (held.state, held.reason) == (CameraState.STREAMING, "")
        assert (held.counters.stale, held.counters.reconnects) == (3, 0)
    assert settled(held)


def test_a_device_with_nothing_but_the_past_is_late_and_then_opened_anew() -> None:
    clock = SimulatedClock()

    class Late(Silent):
        def read(self, timeout_s: float) -> RawPicture | None:
            super().read(timeout_s)
            return replace(picture(), stale="its pictures are 4.0 s old")

    states: list[CameraState] = []

    def leave(shown: RawPicture) -> None:
        LiveCamera._leave_out(held, shown)
        states.append(held.state)

    with closing(camera(Late(clock, 0.3), Scripted(picture()), clock=clock, stall_s=1.0)) as held:
        held._leave_out = leave  # type: ignore[method-assign]
        assert isinstance(next(held.frames()), Frame)
        assert set(states) == {CameraState.LATE}
        assert held.counters.stale == 4
        assert held.counters.reconnects == 1


def test_a_lost_device_is_told_with_its_reason() -> None:
    with closing(camera(Scripted(picture(), ConnectionError("cable cut")), OSError("gone"))) as cut:
        next(cut.frames())
        while cut.reason != "gone":
            assert cut.state is not CameraState.CLOSED
            time.sleep(0.01)
        assert cut.state in {CameraState.LOST, CameraState.CONNECTING}


def test_waiting_doubles_up_to_its_limit_and_starts_again_after_a_picture() -> None:
    waits: list[float] = []
    lost = OSError("gone")
    openings = (
        lost,
        lost,
        lost,
        lost,
        Scripted(picture(), OSError("gone again")),
        lost,
        Scripted(),
    )
    flaky = camera(*openings, first_retry_s=1.0, last_retry_s=4.0)
    flaky._closing.wait = lambda seconds: bool(waits.append(seconds))  # type: ignore[method-assign]
    with closing(flaky):
        next(flaky.frames())
        while len(waits) < 6:
            time.sleep(0.01)
    assert waits[:6] == [1.0, 2.0, 4.0, 4.0, 1.0, 2.0]


def test_a_mistake_in_a_driver_reaches_the_consumer() -> None:
    with (
        closing(camera(Scripted(ZeroDivisionError("oops")))) as broken,
        pytest.raises(ZeroDivisionError, match="oops"),
    ):
        list(broken.frames())


def test_every_start_and_stop_choose_by_index() -> None:
    device = paced(12, picture)
    with closing(camera(device)) as chosen:
        seen = [frame.index for frame in chosen.frames(every=3, start=2, stop=9)]
        chosen.close()
    assert seen == [2, 5, 8]
    assert settled(chosen)
    assert chosen.counters.delivered == 3


@pytest.mark.parametrize(
    ("sequences", "indices", "lost", "duplicates"),
    [
        ((7, 8, 10, 13), [0, 1, 3, 6], 3, 0),
        ((5, 5, 6), [0, 1], 0, 1),
        ((0xFFFFFFFE, 0xFFFFFFFF, 0, 2), [0, 1, 2, 4], 1, 0),
        ((500, 0, 1), [0, 1, 2], 0, 0),
        ((3, 50_000, 50_001), [0, 1, 2], 0, 0),
        ((None, None), [0, 1], 0, 0),
    ],
)
def test_gaps_of_the_devices_counter_are_losses(
    sequences: tuple[int | None, ...], indices: list[int], lost: int, duplicates: int
) -> None:
    device = paced(len(sequences), lambda number: picture(sequences[number]))
    with closing(camera(device)) as counted:
        frames = counted.frames()
        assert [next(frames).index for _ in indices] == indices
    assert (counted.counters.lost, counted.counters.duplicates) == (lost, duplicates)


def test_a_picture_of_another_size_is_left_out() -> None:
    sizes = [SIZE, (64, 48), SIZE]
    device = paced(3, lambda number: picture(size=sizes[number]))
    with closing(camera(device)) as resized:
        frames = resized.frames()
        kinds = [type(next(frames)) for _ in sizes]
    assert kinds == [Frame, Dropped, Frame]
    assert resized.counters.unusable == 1


def test_only_the_newest_waits_and_every_other_is_released() -> None:
    released: list[int] = []

    def numbered(number: int) -> RawPicture:
        shown = picture()
        shown.release = lambda: released.append(number)
        return shown

    gate = threading.Event()

    class Gated(Scripted):
        def read(self, timeout_s: float) -> RawPicture | None:
            if len(self._script) == 999 and not gate.wait(timeout_s):
                return None
            return super().read(timeout_s)

    with closing(camera(Gated(*map(numbered, range(1000))))) as flooded:
        frames = flooded.frames()
        next(frames)
        gate.set()
        while flooded.counters.received < 1000:
            time.sleep(0.01)
        assert len(released) == 999
        assert next(frames).index == 999
    assert sorted(released) == list(range(1000))
    assert settled(flooded)


def test_the_calibration_in_the_config_comes_before_the_devices(tmp_path: Path) -> None:
    own = guess_camera(*SIZE).with_focal_scaled(2.0)
    in_water = CameraModel(64, 48, 50.0, 50.0, 32.0, 24.0)
    save_camera(in_water, tmp_path / "camera.yaml")
    for settings, focal in (({}, own.fx), ({"calibration": tmp_path / "camera.yaml"}, 25.0)):
        with closing(camera(Scripted(picture(), camera=own), **settings)) as calibrated:
            frame = next(calibrated.frames())
        assert isinstance(frame, Frame)
        assert frame.camera.fx == focal
        assert (frame.camera.width, frame.camera.height) == SIZE


def test_a_calibration_stays_when_the_device_comes_back_with_another() -> None:
    first, second = guess_camera(*SIZE), guess_camera(*SIZE).with_focal_scaled(1.1)
    openings = (
        Scripted(picture(), OSError("gone"), camera=first),
        Scripted(picture(), camera=second),
    )
    with closing(camera(*openings)) as frozen:
        frames = frozen.frames()
        seen = [next(frames), next(frames)]
    assert all(isinstance(frame, Frame) and frame.camera == first for frame in seen)
