"""A live camera as a CameraSource: its thread, its state, and its reconnection.

A driver brings a function that opens its device (:mod:`aquaflow.drivers.capture`); all else is here
and the same for every kind of camera.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum

from aquaflow.base.errors import InputError
from aquaflow.config.cameras import LiveCameraConfig
from aquaflow.drivers.capture import Capture, OpenCapture, RawPicture, UnusablePictureError
from aquaflow.drivers.link import Event, about
from aquaflow.geometry.camera import guess_camera, load_camera
from aquaflow.sources import is_asked
from aquaflow.sources.newest import Newest
from aquaflow.types import CameraModel, Dropped, Frame

READ_S = 0.2
"""Longest wait for a picture before the thread checks whether it shall end."""

JOIN_S = 2.0
"""Longest wait for the thread; one that hangs in a device's library ends with the process."""

log = logging.getLogger(__name__)


class LiveCamera:
    """Frames of a device that may be slow, absent, or unplugged at any time."""

    frame_count: int | None = None

    def __init__(
        self,
        name: str,
        config: LiveCameraConfig,
        open_capture: OpenCapture,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Nothing is opened yet.

        Raises:
            ConfigError, InputError: the calibration named in ``config`` cannot be read.
        """
        self.name = name
        self.camera: CameraModel | None = (
            None if config.calibration is None else load_camera(config.calibration)
        )
        self.notes: list[str] = []
        self.state = CameraState.CLOSED
        self.reason = ""
        """Why the camera is lost, for people."""
        self.flow = DeviceState(now_ns)
        self._config = config
        self._open_capture = open_capture
        self._now_ns = now_ns
        self._opened: Capture | None = None
        self._opened_anew = False
        """Pictures came before the device was opened this time."""
        self._size: tuple[int, int] | None = None
        self._format = ""
        self._counts = CameraCounters()
        self._clock = ExposureClock()
        self._newest: Newest[RawPicture] = Newest(discard=lambda picture: picture.release())
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure: Exception | None = None
        self._index = 0
        self._sequence = SequenceGaps()

    @property
    def counters(self) -> CameraCounters:
        """Counts of pictures so far."""
        self._counts.overtaken = self._newest.overtaken
        self._counts.stamps_repaired = self._clock.repaired
        return self._counts

    def connect(self) -> None:
        """Open the device now, so that a wrong id is reported before the dive.

        Without it, :meth:`frames` waits until the device is there.

        Raises:
            InputError: the device is not there or refuses.
        """
        if self._opened is None and self._thread is None:
            try:
                self._opened = self._open()
            except OSError as error:
                raise InputError(f"camera '{self.name}': {error}") from error

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        """Yield the newest picture repeatedly, until :meth:`close` or index ``stop``.

        An index counts what the device took, so it jumps where pictures were lost or overtaken.

        Raises:
            Exception: what went wrong in the driver, if it was not the device.
        """
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=self.name, daemon=True)
            self._thread.start()
        while (picture := self._newest.take()) is not None:
            try:
                ended = stop is not None and picture.index >= stop
                asked = is_asked(picture.index, every, start)
                frame = self._frame(picture) if asked and not ended else None
            finally:
                picture.release()
            if frame is not None:
                yield frame
            else:
                self._counts.passed_over += 1
            if ended:
                return
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """End iteration and close the device; may be called from any thread, and again."""
        self._closing.set()
        self._newest.end(discard=True)
        if self._thread is not None:
            self._thread.join(JOIN_S)
        elif self._opened is not None:
            self._opened.close()
        self._opened = None
        self.state = CameraState.CLOSED

    def _frame(self, picture: RawPicture) -> Frame | Dropped:
        try:
            image = picture.decode()
            height, width = image.shape[:2]
            self._size = self._size or (width, height)
            if (width, height) != self._size:
                raise UnusablePictureError(f"is {width} x {height} px, not {self._size}")
        except UnusablePictureError as error:
            self._counts.unusable += 1
            return Dropped(picture.index, picture.t_ns, f"{self.name}#{picture.index} {error}")
        self._counts.delivered += 1
        camera = self.camera or guess_camera(width, height)
        return Frame(
            picture.index,
            picture.t_ns,
            picture.arrival_ns,
            image,
            camera if (camera.width, camera.height) == self._size else camera.resize(width, height),
            picture.exposure_s,
            picture.gain,
            encoded=picture.received(),
        )

    def _run(self) -> None:
        """The thread: open, stream until the device is lost, wait, and again."""
        retry_s = self._config.first_retry_s
        try:
            while not self._closing.is_set():
                received = self._counts.received
                try:
                    self._stream()
                except OSError as error:
                    self._lose(error)
                    if self._counts.received > received:
                        retry_s = self._config.first_retry_s
                    self._closing.wait(retry_s)
                    retry_s = min(2.0 * retry_s, self._config.last_retry_s)
        except Exception as error:  # a consumer must hear of it, not wait forever
            self._failure = error
        finally:
            self._newest.end(discard=True)

    def _lose(self, error: OSError) -> None:
        if str(error) != self.reason:
            if self.state in (CameraState.STREAMING, CameraState.LATE):
                self._tell("lost", f"is lost: {error}")
            else:
                self._tell("waiting", f"is waited for: {error}")
        self.state, self.reason = CameraState.LOST, str(error)

    def _tell(self, event: Event, text: str, level: int = logging.WARNING) -> None:
        log.log(level, "camera '%s' %s", self.name, text, extra=about(self.name, event))

    def _open(self) -> Capture:
        self.state = CameraState.CONNECTING
        self._opened_anew = self._counts.received > 0
        capture = self._open_capture()
        # Calibration is frozen: what is mapped with one camera model stays with it.
        self.camera = self.camera or capture.camera
        self.notes = [*dict.fromkeys([*self.notes, *capture.notes])]
        if capture.format != self._format:
            self._format = capture.format
            self._tell("format", f"gives {capture.format}", logging.INFO)
        return capture

    def _stream(self) -> None:
        """Pictures from one opening of the device; ends by OSError or by :meth:`close`."""
        capture, self._opened = self._opened or self._open(), None
        try:
            self._sequence = SequenceGaps()
            heard_ns = self._now_ns()
            while not self._closing.is_set():
                picture = capture.read(min(READ_S, self._config.stall_s))
                if picture is not None and self._queue(picture):
                    heard_ns = self._now_ns()
                elif self._now_ns() - heard_ns > self._config.stall_s * 1e9:
                    said = "no picture" if picture is None else picture.stale
                    raise TimeoutError(f"{said} for {self._config.stall_s:g} s")
        finally:
            capture.close()

    def _queue(self, picture: RawPicture) -> bool:
        """Queue a picture; False if it is too old to count as a sign of life."""
        self._counts.received += 1
        lost = self._sequence.before(picture.sequence)
        if lost is None:
            self._counts.duplicates += 1
            picture.release()
            return True
        self._counts.lost += lost
        picture.index = self._index + lost
        self._index = picture.index + 1
        if picture.stale:
            self._leave_out(picture)
            return False
        if self.state is not CameraState.STREAMING:
            self.state, self.reason = CameraState.STREAMING, ""
            event: Event = "reconnected" if self._opened_anew else "connected"
            self._tell(event, f"is {event}", logging.INFO)
            self._counts.reconnects += self._opened_anew
            self._opened_anew = False
        picture.t_ns = self._clock.stamp(picture.exposed_ns, picture.device_ns, picture.arrival_ns)
        self.flow.record(picture.t_ns, picture.arrival_ns)
        self._newest.put(picture)
        return True

    def _leave_out(self, picture: RawPicture) -> None:
        """A picture that would show the past as the present."""
        if self.state is CameraState.STREAMING:
            self._tell("late", f"is late: {picture.stale}")
        self.state, self.reason = CameraState.LATE, picture.stale
        self._counts.stale += 1
        picture.release()


# --------------------------------------------------------------------------------------------------
# What a live camera says of itself: its state, and where its pictures went.


class CameraState(Enum):
    """States of a camera from unplugged to delivering pictures."""

    CLOSED = "closed"
    CONNECTING = "connecting"
    STREAMING = "streaming"
    LATE = "late"
    """Its pictures are too old to be used, or of unknown age."""
    LOST = "lost"


@dataclass
class CameraCounters:
    """Pictures since the source was made; every received one ends in exactly one other counter,
    but for the one that may be waiting or held by the consumer."""

    received: int = 0
    delivered: int = 0
    overtaken: int = 0
    """A newer one came before the consumer took it."""
    passed_over: int = 0
    """Not asked for: sub-sampling."""
    stale: int = 0
    """Too old when it came, or of unknown age, by the time that a stream itself carries."""
    unusable: int = 0
    """Damaged, or of another size than those before."""
    duplicates: int = 0
    lost: int = 0
    """Never received: gaps in the device's own counter."""
    stamps_repaired: int = 0
    reconnects: int = 0


# --------------------------------------------------------------------------------------------------
# When a picture was exposed: what the device claims, checked, strictly increasing.
#
# Device time synchronisation has been seen to jump by seconds (luxonis/depthai-ros#53), and vivid's
# stamps lie up to 30 ms in the future; a wrong time costs more than a slightly late one.

MAX_FUTURE_NS = 50_000_000
"""A stamp may lie this far after the arrival: vivid's do by up to 30 ms."""

MAX_LATENCY_NS = 2_000_000_000
"""An older stamp is rejected; the slowest live path seen is an RTSP camera with 1 s."""

MAX_SLEW = 0.01
"""The offset between device and host follows the claimed offset by at most this much per second of
device time: drift is 1e-4 at worst, so a jump of synchronisation is recognised."""

REPAIR_NS = 5_000_000
"""A time that differs by more than this from what was claimed counts as repaired; following the
drift of two clocks does not."""


class ExposureClock:
    """Turns claimed exposure times into reliable CLOCK_MONOTONIC times.

    Where the device also gives its own clock, time advances by that clock, and a jump of the
    host's idea of it is bridged. Otherwise an implausible claim is replaced by the arrival.
    """

    def __init__(self) -> None:
        self.repaired = 0
        """Stamps that were not what the device claimed."""
        self._last_ns = -1
        self._device_ns: int | None = None
        self._offset_ns = 0

    def stamp(self, claimed_ns: int | None, device_ns: int | None, arrival_ns: int) -> int:
        """Moment of exposure of a picture that arrived at ``arrival_ns``."""
        source_ns = claimed_ns if claimed_ns is not None else arrival_ns
        t_ns = source_ns
        if device_ns is not None and claimed_ns is not None:
            t_ns = self._bridge(claimed_ns, device_ns, arrival_ns)
        if not _plausible(t_ns, arrival_ns):
            t_ns = arrival_ns
        t_ns = max(t_ns, self._last_ns + 1)
        self.repaired += abs(t_ns - source_ns) > REPAIR_NS
        self._last_ns = t_ns
        return t_ns

    def _bridge(self, claimed_ns: int, device_ns: int, arrival_ns: int) -> int:
        """The device's clock plus an offset that follows the claimed one slowly."""
        wanted_ns = claimed_ns - device_ns
        known = self._device_ns is not None and _plausible(device_ns + self._offset_ns, arrival_ns)
        if not known:
            self._offset_ns = wanted_ns
        elif _plausible(claimed_ns, arrival_ns) and self._device_ns is not None:
            reach_ns = round(abs(device_ns - self._device_ns) * MAX_SLEW)
            self._offset_ns += max(-reach_ns, min(reach_ns, wanted_ns - self._offset_ns))
        self._device_ns = device_ns
        return device_ns + self._offset_ns


def _plausible(t_ns: int, arrival_ns: int) -> bool:
    return -MAX_FUTURE_NS <= arrival_ns - t_ns <= MAX_LATENCY_NS


# --------------------------------------------------------------------------------------------------
# How the data of one device flow: how many a second, how old the newest is, how late it came.

WINDOW_S = 10
"""Seconds over which rate and lag are taken: a fix each 5 s still has a rate."""
SECOND_NS = 1_000_000_000


class _Second:
    """What came within one second."""

    __slots__ = ("count", "lag_ns", "number")

    def __init__(self, number: int) -> None:
        self.number, self.count, self.lag_ns = number, 0, 0


class DeviceState:
    """Written by the device's thread, read by anyone."""

    def __init__(self, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._now_ns = now_ns
        self._newest_ns: int | None = None
        self._first = 0
        """The second in which the first one came."""
        self._seconds: deque[_Second] = deque(maxlen=WINDOW_S + 1)

    def record(self, measured_ns: int, arrival_ns: int) -> None:
        """A picture or a sample; both moments are CLOCK_MONOTONIC."""
        number = arrival_ns // SECOND_NS
        if self._newest_ns is None:
            self._first = number
        self._newest_ns = arrival_ns
        if not self._seconds or self._seconds[-1].number != number:
            self._seconds.append(_Second(number))
        second = self._seconds[-1]
        second.count += 1
        second.lag_ns += arrival_ns - measured_ns

    def to_json(self) -> dict[str, float | None]:
        """``rate_hz`` over the last whole seconds, ``age_s`` of the newest, and ``lag_ms``, the
        mean time from measurement to arrival; None where nothing came."""
        now_ns, newest_ns = self._now_ns(), self._newest_ns
        if newest_ns is None:
            return {"rate_hz": None, "age_s": None, "lag_ms": None}
        number = now_ns // SECOND_NS
        recent = [each for each in list(self._seconds) if number - each.number <= WINDOW_S]
        whole = sum(each.count for each in recent if each.number < number)
        count, lag_ns = sum(each.count for each in recent), sum(each.lag_ns for each in recent)
        return {
            "rate_hz": round(whole / min(WINDOW_S, max(1, number - self._first)), 2),
            "age_s": round((now_ns - newest_ns) * 1e-9, 3),
            "lag_ms": round(lag_ns * 1e-6 / count, 3) if count else None,
        }


# --------------------------------------------------------------------------------------------------
# Pictures that a device counted and never delivered.

SEQUENCE_BITS = 32
"""Width of V4L2's counter, which then starts at 0; the OAK's is wider and never gets there."""

MAX_GAP = 9000
"""A larger gap (5 minutes at 30 pictures/s) is a counter that started anew, not a loss."""


class SequenceGaps:
    """Follows a device's counter while the device stays open."""

    def __init__(self) -> None:
        self._last: int | None = None

    def before(self, sequence: int | None) -> int | None:
        """How many were lost just before this picture; None if it is the last one again."""
        last, self._last = self._last, sequence
        if last is None or sequence is None:
            return 0
        step = (sequence - last) % (1 << SEQUENCE_BITS)
        if step == 0:
            return None
        return step - 1 if step <= MAX_GAP else 0
