"""Items into files: topics, and when a new file begins."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter, deque
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow import __version__
from aquaflow.base.clocks.wall import WallClockWatch
from aquaflow.config.service import RecordingConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.live.recorder.dive_file import DiveFile
from aquaflow.live.recorder.status import RecorderStatus
from aquaflow.recordings.telemetry_lines import sample_to_json
from aquaflow.types import KIND_OF, CameraModel, Dropped, EncodedPicture, Frame, TelemetrySample

FORMAT = "1"
"""Of topics and metadata."""

MB = 1_000_000
"""Bytes of a megabyte, the unit of the settings."""

LATE_KEY_S = 10.0
"""A video's next key frame is waited for this long before a new file begins without it."""


class DiveWriter:
    """Writes to the file in progress and begins the next when it is long enough.

    Every file stands alone: calibrations and masks are repeated, video begins with a key frame.
    """

    def __init__(self, folder: Path, settings: RecordingConfig, status: RecorderStatus) -> None:
        self._folder, self._settings, self._status = folder, settings, status
        self._watch = WallClockWatch(tell=False)  # the source of UTC tells
        self._finished_bytes = 0
        self._masks: dict[str, npt.NDArray[np.bool_]] = {}
        self._has_video = False
        self.mountings: dict[str, MountingConfig] = {}
        """Of cameras in the vehicle, as far as they are known; for the metadata of each file."""
        self._begin()

    def write(self, item: Item) -> None:
        """Write one item.

        Raises:
            OSError: the disk does not take it.
            ValueError: it cannot be encoded.
        """
        if self._is_long() and self._may_cut_before(item):
            self._finish()
            self._begin()
        if isinstance(item, LinkBytes):
            self._file.raw(item.topic, item.data, item.arrival_ns)
            self._status.link_bytes += len(item.data)
        elif not isinstance(item, QueuedPicture):
            self._sample(item.topic, item.sample)
        elif isinstance(item.frame, Dropped):
            self._missing(item.topic, item.frame)
        else:
            self._picture(item.camera, item.frame)
        self._status.written_bytes = self._finished_bytes + self._file.size

    def flush(self) -> None:
        """Bring everything to the disk, with the clocks and the counts of this moment."""
        now = self._watch.read()
        self._status.wall_clock_jumps = self._watch.jumps
        self._json("/clock", "WallClock", vars(now), now.monotonic_ns)
        self._json("/recorder", "Recorder", self._status.to_json(), now.monotonic_ns)
        begun = time.monotonic()
        self._file.flush()
        took = time.monotonic() - begun
        self._status.slowest_flush_s = max(self._status.slowest_flush_s, round(took, 4))

    def close(self) -> None:
        """The last counts, the index, and the end."""
        self.flush()
        self._finish()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._file.abandon()

    def _begin(self) -> None:
        path = self._folder / f"{len(self._status.files):04d}.mcap"
        self._file = DiveFile(path, 1000 * self._settings.chunk_kb)
        self._begun = time.monotonic()
        self._status.files.append(path)
        self._announced: set[str] = set()
        self._masks.clear()
        clock = self._watch.read()
        facts = {
            "format": FORMAT,
            "version": __version__,
            "file": str(len(self._status.files) - 1),
            "clock": "CLOCK_MONOTONIC, ns",
            "wall_clock_offset_ns": str(clock.offset_ns),
        }
        self._file.metadata("aquaflow", facts)

    def _finish(self) -> None:
        self._file.close()
        self._finished_bytes += self._file.size

    def _is_long(self) -> bool:
        old = time.monotonic() - self._begun >= self._settings.file_s
        return old or self._file.size >= self._settings.file_mb * MB

    def _may_cut_before(self, item: Item) -> bool:
        if not self._has_video:
            return True
        late = time.monotonic() - self._begun >= self._settings.file_s + LATE_KEY_S
        frame = item.frame if isinstance(item, QueuedPicture) else None
        encoded = frame.encoded if isinstance(frame, Frame) else None
        return late or (encoded is not None and encoded.format == "h264" and encoded.key)

    def _picture(self, camera: str, frame: Frame) -> None:
        message = picture_message(frame, camera, self._settings)
        if camera not in self._announced:
            self._announced.add(camera)
            self._file.metadata(f"camera:{camera}", self._facts_of(camera, frame.camera))
            calibration = calibration_message(frame.camera, frame.t_ns, camera)
            self._protobuf(f"/{camera}/calibration", calibration, frame)
        known = self._masks.get(camera)
        if frame.mask is not None and (known is None or not np.array_equal(frame.mask, known)):
            self._masks[camera] = frame.mask
            mask = mask_message(frame.mask, frame.t_ns, camera)
            self._protobuf(f"/{camera}/mask", mask, frame)
        if frame.exposure_s is not None or frame.gain is not None:
            exposure = {"exposure_s": frame.exposure_s, "gain": frame.gain}
            self._json(
                f"/{camera}/exposure", "Exposure", exposure, frame.arrival_ns, frame.t_ns,
                frame.index,
            )  # fmt: skip
        video = message.DESCRIPTOR.name == "CompressedVideo"
        self._has_video |= video
        self._protobuf(f"/{camera}/{'video' if video else 'image'}", message, frame)
        self._status.frames += 1

    def _facts_of(self, camera: str, model: CameraModel) -> dict[str, str]:
        facts = {"model": camera_to_json(model)}
        mounting = self.mountings.get(camera)
        return facts if mounting is None else facts | {"mounting": mounting.model_dump_json()}

    def _missing(self, topic: str, dropped: Dropped) -> None:
        reason = {"reason": dropped.reason}
        self._json(f"{topic}/dropped", "Dropped", reason, dropped.t_ns, dropped.t_ns, dropped.index)

    def _sample(self, topic: str, sample: TelemetrySample) -> None:
        kind = KIND_OF[type(sample)]
        data = sample_to_json(sample)
        self._file.json(f"{topic}/{kind}", kind, data, sample.arrival_ns, sample.t_ns)
        self._status.samples += 1

    def _protobuf(self, topic: str, message: Any, frame: Frame) -> None:
        self._file.protobuf(topic, message, frame.arrival_ns, frame.t_ns, frame.index)

    def _json(
        self,
        topic: str,
        kind: str,
        values: dict[str, Any],
        arrival_ns: int,
        t_ns: int | None = None,
        number: int = 0,
    ) -> None:
        data = json.dumps(values, allow_nan=False).encode()
        self._file.json(topic, kind, data, arrival_ns, arrival_ns if t_ns is None else t_ns, number)


# --------------------------------------------------------------------------------------------------
# The queue of what is to be written, bounded in bytes: a slow disk costs data, not the dive.

SAMPLE_BYTES = 400
"""A telemetry sample in memory, about."""


@dataclass(frozen=True)
class QueuedPicture:
    """A frame of a camera, or the note that one is missing."""

    camera: str
    frame: Frame | Dropped

    @property
    def topic(self) -> str:
        """Topic of the MCAP file."""
        return f"/{self.camera}"

    @property
    def size(self) -> int:
        """Bytes that it takes in memory."""
        if isinstance(self.frame, Dropped):
            return SAMPLE_BYTES
        received = 0 if self.frame.encoded is None else len(self.frame.encoded.data)
        return self.frame.image.nbytes + received


@dataclass(frozen=True)
class QueuedSample:
    """A decoded telemetry sample."""

    sample: TelemetrySample
    size: int = SAMPLE_BYTES

    @property
    def topic(self) -> str:
        """Topic of the MCAP file."""
        return f"/telemetry/{self.sample.source}"


@dataclass(frozen=True)
class LinkBytes:
    """What one read of a link returned."""

    link: str
    arrival_ns: int
    data: bytes

    @property
    def topic(self) -> str:
        """Topic of the MCAP file."""
        return f"/links/{self.link}"

    @property
    def size(self) -> int:
        """Bytes that it takes in memory."""
        return SAMPLE_BYTES + len(self.data)


Item: TypeAlias = QueuedPicture | QueuedSample | LinkBytes


class WriteQueue:
    """A queue whose producers never wait: what does not fit is dropped and counted."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._items: deque[Item] = deque()
        self._bytes = 0
        self._dropped: Counter[str] = Counter()
        self._changed = threading.Condition()

    def put(self, item: Item) -> bool:
        """Queue ``item``; False if there is no room for it."""
        with self._changed:
            if self._bytes + item.size > self._limit:
                self._dropped[item.topic] += 1
                return False
            self._items.append(item)
            self._bytes += item.size
            self._changed.notify()
            return True

    def take(self, timeout_s: float) -> Item | None:
        """The oldest item; None if ``timeout_s`` passed without one, or :meth:`wake` was called."""
        with self._changed:
            if not self._items:
                self._changed.wait(max(timeout_s, 0.0))
            if not self._items:
                return None
            item = self._items.popleft()
            self._bytes -= item.size
            return item

    def wake(self) -> None:
        """Let :meth:`take` return."""
        with self._changed:
            self._changed.notify_all()

    def refuse(self, topic: str) -> None:
        """Count an item of ``topic`` that was taken but could not be written."""
        with self._changed:
            self._dropped[topic] += 1

    def drop(self) -> dict[str, int]:
        """Dropped items by topic."""
        with self._changed:
            return dict(self._dropped)


# --------------------------------------------------------------------------------------------------
# Pictures as messages: the bytes that the camera delivered, else encoded here.

FOXGLOVE_DISTORTION = {"none": "", "radtan": "plumb_bob", "fisheye": "kannala_brandt"}
"""Distortion models by Foxglove's names."""
PLUMB_BOB_COEFFICIENTS = 5
"""That ``plumb_bob`` has."""


def picture_message(frame: Frame, name: str, settings: RecordingConfig) -> Any:
    """``frame`` as foxglove.CompressedImage, CompressedVideo or RawImage (protobuf)."""
    encoded = frame.encoded if settings.keep_received else None
    if encoded is None and settings.picture != "raw":
        encoded = encode(frame.image, settings)
    message = _empty(encoded)
    message.timestamp.FromNanoseconds(frame.t_ns)
    message.frame_id = name
    if encoded is not None:
        message.format, message.data = encoded.format, encoded.data
        return message
    message.height, message.width = frame.image.shape[:2]
    message.encoding, message.step = "rgb8", 3 * frame.image.shape[1]
    message.data = np.ascontiguousarray(frame.image).tobytes()
    return message


def encode(
    image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    settings: RecordingConfig,
) -> EncodedPicture:
    """JPEG or PNG, by the settings."""
    import cv2

    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    if settings.picture == "png":
        # Measured on reef_clip at 640x480: 10 ms and 0.61 MB; OpenCV's fastest level alone takes
        # 24 ms for 0.55 MB.
        flags = [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
        flags += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]
        return EncodedPicture("png", cv2.imencode(".png", bgr, flags)[1].tobytes())
    flags = [cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality]
    return EncodedPicture("jpeg", cv2.imencode(".jpg", bgr, flags)[1].tobytes())


def mask_message(
    mask: npt.NDArray[np.bool_],  # [H, W]
    t_ns: int,
    name: str,
) -> Any:
    """A frame's mask as a PNG, 255 where the pixel shows the scene."""
    import cv2

    png = cv2.imencode(".png", mask.astype(np.uint8) * 255)[1].tobytes()
    message = _empty(EncodedPicture("png", png))
    message.timestamp.FromNanoseconds(t_ns)
    message.frame_id, message.format, message.data = name, "png", png
    return message


def calibration_message(camera: CameraModel, t_ns: int, name: str) -> Any:
    """``camera`` as foxglove.CameraCalibration; OpenCV's pixel centres are integers, ours not."""
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

    message = CameraCalibration()
    message.timestamp.FromNanoseconds(t_ns)
    message.frame_id = name
    message.width, message.height = camera.width, camera.height
    longer = len(camera.distortion) > PLUMB_BOB_COEFFICIENTS
    model = FOXGLOVE_DISTORTION[camera.distortion_model]
    message.distortion_model = "rational_polynomial" if longer and model == "plumb_bob" else model
    message.D.extend(camera.distortion)
    K = camera.K
    K[:2, 2] -= 0.5
    message.K.extend(K.ravel())
    message.R.extend(np.eye(3).ravel())
    message.P.extend(np.hstack([K, np.zeros((3, 1))]).ravel())
    return message


def camera_to_json(camera: CameraModel) -> str:
    """Every bit of the calibration, for reading back."""
    return json.dumps(asdict(camera))


def _empty(encoded: EncodedPicture | None) -> Any:
    if encoded is None:
        from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

        return RawImage()
    if encoded.format == "h264":
        from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo

        return CompressedVideo()
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    return CompressedImage()
