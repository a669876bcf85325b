"""The recorder: accepts data from any thread without blocking, writes in its own thread.

Topics: ``/CAMERA/image`` or ``/CAMERA/video`` (foxglove schemas), ``/CAMERA/calibration``,
``/CAMERA/exposure``, ``/CAMERA/mask``, ``/CAMERA/dropped``, ``/telemetry/SOURCE/KIND`` (JSON),
``/links/LINK`` (raw bytes), ``/clock`` and ``/recorder``. A message's log time is its arrival, its
publish time the moment of exposure or measurement, both CLOCK_MONOTONIC.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.config.service import RecordingConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.live.recorder.status import RecorderStatus
from aquaflow.live.recorder.writing import (
    DiveWriter,
    Item,
    LinkBytes,
    QueuedPicture,
    QueuedSample,
    WriteQueue,
)
from aquaflow.recordings.mcap_messages import require_mcap
from aquaflow.types import Dropped, Frame, TelemetrySample

# --------------------------------------------------------------------------------------------------
# Room on a disk.


def free_bytes(folder: Path) -> int:
    """What a user without privileges may still write to the disk of ``folder``."""
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize


log = logging.getLogger(__name__)


# --------------------------------------------------------------------------------------------------
# The recorder.

MB = 1_000_000
"""Bytes of a megabyte, the unit of the settings."""


class Recorder:
    """Writes a folder of MCAP files; ``frame``, ``sample`` and ``raw`` never block."""

    def __init__(
        self,
        folder: Path,
        settings: RecordingConfig,
        free: Callable[[Path], int] = free_bytes,
    ) -> None:
        """Begin the recording; ``free`` returns the free bytes of the disk under a folder.

        Raises:
            InputError: the folder holds a recording, cannot be written, or the disk is full.
        """
        require_mcap()
        self.status = RecorderStatus()
        self._settings, self._folder, self._free = settings, folder, free
        self._prepare_folder()
        self._queue = WriteQueue(settings.queue_mb * MB)
        self._writer = DiveWriter(folder, settings, self.status)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def record_mounting(self, camera: str, mounting: MountingConfig | None) -> None:
        """State how a camera sits in the vehicle, before its first picture; None: not known."""
        if mounting is not None:
            self._writer.mountings[camera] = mounting

    def frame(self, camera: str, frame: Frame | Dropped) -> None:
        """Record a picture; its ``image`` must not change afterwards."""
        self._put(QueuedPicture(camera, frame))

    def sample(self, sample: TelemetrySample) -> None:
        """Record a decoded sample."""
        self._put(QueuedSample(sample))

    def raw(self, link: str, arrival_ns: int, data: bytes) -> None:
        """Record what one read of a link returned; a ``RawTap`` of ``aquaflow.sources``."""
        self._put(LinkBytes(link, arrival_ns, bytes(data)))

    def close(self) -> RecorderStatus:
        """Write what waits, end the last file, and return the status; may be called again."""
        self._closing.set()
        self._queue.wake()
        self._thread.join()
        self.status.dropped = self._queue.drop()
        return self.status

    def _prepare_folder(self) -> None:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            if any(self._folder.glob("*.mcap")):
                raise InputError(f"{self._folder} already holds a recording; give another --out")
            full = self._full()
        except OSError as error:
            raise InputError(
                f"cannot record to {self._folder}: {error.strerror}; give another --out"
            ) from error
        if full is not None:
            raise InputError(full)

    def _put(self, item: Item) -> None:
        if self.status.stopped is None and not self._closing.is_set():
            self._queue.put(item)

    def _run(self) -> None:
        """The thread: write, flush every so often, until closed or the disk is full."""
        try:
            self._write_until_closed()
            self._writer.close()
        except OSError as error:
            self._stop(f"the disk takes no more: {error.strerror}")
            self._writer.abandon()
        except Exception as error:
            self._stop(f"the recorder failed: {error}")
            log.exception("the recorder failed")
            self._writer.abandon()

    def _write_until_closed(self) -> None:
        due = time.monotonic()
        while self.status.stopped is None:
            item = self._queue.take(due - time.monotonic())
            if item is not None:
                self._write(item)
            elif self._closing.is_set():
                return
            if time.monotonic() >= due:
                self.status.dropped = self._queue.drop()
                self._writer.flush()
                due = time.monotonic() + self._settings.flush_s
                full = self._full()
                if full is not None:
                    self._stop(full)

    def _write(self, item: Item) -> None:
        try:
            self._writer.write(item)
        except OSError:
            raise
        except Exception as error:  # a message that cannot be encoded is skipped and counted
            self._queue.refuse(item.topic)
            log.warning("not recorded, of %s: %s", item.topic, error)

    def _stop(self, reason: str) -> None:
        self.status.stopped = reason
        fields = {"event": "stopped", "source": "recorder"}
        log.error("recording stopped: %s", reason, extra={"fields": fields})

    def _full(self) -> str | None:
        free = self._free(self._folder)
        if free >= self._settings.reserve_mb * MB:
            return None
        return (
            f"the disk of {self._folder} has {free // MB} MB left, and {self._settings.reserve_mb} "
            "MB are kept free; delete old recordings or lower recording.reserve_mb"
        )
