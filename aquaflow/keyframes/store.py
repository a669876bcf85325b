"""Keyframes and their fused pointmaps: what tracking and mapping share."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.storage.archive import Arrays
from aquaflow.base.storage.spill import Spill
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes.place import LearnedDepths, Pointmap
from aquaflow.prior.contract import Encoding, Prior

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

RESIDENT_KEYFRAMES = 32
"""Keyframes in memory while the others wait in files: the current one, the last ones that a bundle
adjustment takes, and some candidates of loop closures. About 5 MB each at 480 x 270 px."""


@dataclass(frozen=True)
class _Content:
    """What a keyframe keeps of every pixel."""

    encoding: Encoding
    pointmap: Pointmap


@dataclass(eq=False)
class Keyframe:
    """A frame that others are tracked against; pose and sub-map may be set at any time."""

    number: int
    """Position in the store."""
    frame_index: int
    t_ns: int
    T_wc: Sim3
    sub_map: int
    _store: KeyframeStore = field(repr=False)

    @property
    def encoding(self) -> Encoding:
        """What the prior keeps of the keyframe's picture."""
        return self._store.content(self.number).encoding

    @property
    def pointmap(self) -> Pointmap:
        """Writable while the store holds this keyframe; of any other, set a new one instead."""
        return self._store.content(self.number).pointmap

    @pointmap.setter
    def pointmap(self, pointmap: Pointmap) -> None:
        self._store.replace_pointmap(self.number, pointmap)


class KeyframeStore:
    """All keyframes of a dive, in the order of their making.

    With a work folder, encodings and pointmaps of all but the last used keyframes wait in its
    ``keyframes`` folder and come back, bit for bit, when they are looked up. Any thread may look
    them up, and one changes them; what is held may change while another thread reads it.
    """

    def __init__(
        self,
        work: Path | None = None,
        prior: Prior | None = None,
        resident: int = RESIDENT_KEYFRAMES,
    ) -> None:
        """``prior`` made the encodings, and packs them; a work folder needs it."""
        if work is not None and prior is None:
            raise ValueError("keyframes go to a work folder only with the prior that packs them")
        self.keyframes: list[Keyframe] = []
        self._prior = prior
        self._cameras: list[tuple[CameraModel, CameraModel]] = []
        """Of encoding and pointmap: before calibration they may differ."""
        folder = None if work is None else work / "keyframes"
        self._contents = Spill(folder, resident, self._pack, self._unpack)
        self._lock = threading.RLock()
        self._held: int | None = None
        self.lost: set[int] = set()
        """Numbers of the keyframes whose file was lost: they have a pose, and no content."""

    def add(
        self,
        frame_index: int,
        t_ns: int,
        encoding: Encoding,
        T_wc: Sim3,
        pointmap: Pointmap,
        sub_map: int,
    ) -> Keyframe:
        """Append a keyframe and hold it; the pointmap is the store's own from here on.

        Raises:
            ArithmeticError: its pose is not finite.
        """
        number = len(self.keyframes)
        keyframe = Keyframe(number, frame_index, t_ns, T_wc.if_finite(), sub_map, self)
        self.keyframes.append(keyframe)
        self._cameras.append((encoding.camera, pointmap.camera))
        self._set(number, _Content(encoding, pointmap))
        return self.load(number)

    def load(self, number: int) -> Keyframe:
        """Make this the one keyframe whose pointmap may be changed in place, until the next call.

        The one held before becomes read-only: from here on it may lie in a file.

        Raises:
            InputError: it cannot be read back; the one held before still is.
        """
        before = None if self._held is None else self.content(self._held).pointmap
        with self._lock:
            self._contents.pin(number)
        if before is not None:
            _set_writable(before, False)
        self._held = number
        _set_writable(self.content(number).pointmap, True)
        return self.keyframes[number]

    def content(self, number: int) -> _Content:
        """Encoding and pointmap.

        Raises:
            InputError: they cannot be read back, or were lost.
        """
        if number in self.lost:
            raise InputError(f"what keyframe {number} showed was lost")
        with self._lock:
            return self._contents[number]

    def _set(self, number: int, content: _Content) -> None:
        with self._lock:
            self._contents[number] = content

    def replace_pointmap(self, number: int, pointmap: Pointmap) -> None:
        """A better pointmap for a keyframe; it is the store's own from here on."""
        _set_writable(pointmap, number == self._held)
        self._cameras[number] = (self._cameras[number][0], pointmap.camera)
        self._set(number, replace(self.content(number), pointmap=pointmap))

    @property
    def readable(self) -> list[Keyframe]:
        """All but the ``lost`` ones."""
        return [each for each in self.keyframes if each.number not in self.lost]

    def __len__(self) -> int:
        return len(self.keyframes)

    def __getitem__(self, number: int) -> Keyframe:
        return self.keyframes[number]

    @property
    def resident_bytes(self) -> int:
        """Size of the encodings and pointmaps in memory; asks the prior."""
        with self._lock:
            return self._contents.resident_bytes

    def save(self) -> list[Path]:
        """Write what is only in memory; the files that are new."""
        with self._lock:
            return self._contents.save()

    def restore(
        self,
        frame_index: int,
        t_ns: int,
        T_wc: Sim3,
        sub_map: int,
        cameras: tuple[CameraModel, CameraModel],
    ) -> Keyframe:
        """Append a keyframe that an earlier run saved; ``cameras`` of encoding and pointmap.

        Without its file it is one of the ``lost``: frames whose pose is relative to it keep their
        poses; no further frame is tracked against it.
        """
        number = len(self.keyframes)
        if not self._contents.restore(number):
            self.lost.add(number)
        self._cameras.append(cameras)
        self.keyframes.append(Keyframe(number, frame_index, t_ns, T_wc, sub_map, self))
        return self.keyframes[number]

    def cameras_of(self, number: int) -> tuple[CameraModel, CameraModel]:
        """The cameras of encoding and pointmap."""
        return self._cameras[number]

    def close(self, keep: bool = False) -> None:
        """Remove the files; or, to ``keep`` them, write what is only in memory too."""
        self._contents.close(keep)

    def _pack(self, content: _Content) -> Arrays:
        assert self._prior is not None
        pointmap = content.pointmap
        arrays: Arrays = {"rho": pointmap.rho, "variance": pointmap.variance}
        arrays["fused"] = np.array([pointmap.fused])
        if pointmap.learned is not None:
            learned = pointmap.learned
            arrays["learned"] = np.stack([learned.rho, learned.variance]).astype(np.float32)
            arrays["learned_scale"] = np.array([learned.log_scale, learned.log_scale_sigma])
        packed = self._prior.pack(content.encoding)
        return arrays | {f"encoding.{name}": array for name, array in packed.items()}

    def _unpack(
        self,
        number: int,
        arrays: Arrays,  # as from _pack
    ) -> _Content:
        assert self._prior is not None
        encoding_camera, pointmap_camera = self._cameras[number]
        rho, variance, fused = (arrays.pop(name) for name in ("rho", "variance", "fused"))
        pointmap = Pointmap(pointmap_camera, rho, variance, int(fused[0]), _unpack_learned(arrays))
        _set_writable(pointmap, False)
        packed = {name.removeprefix("encoding."): array for name, array in arrays.items()}
        return _Content(self._prior.unpack(packed, encoding_camera), pointmap)


def _set_writable(pointmap: Pointmap, writable: bool) -> None:
    """A change that would be lost with the file's next reading is refused by numpy."""
    pointmap.rho.setflags(write=writable)
    pointmap.variance.setflags(write=writable)


def _unpack_learned(
    arrays: Arrays,  # as from _pack
) -> LearnedDepths | None:
    """What ``_pack`` wrote, taken out of ``arrays``; None for a pointmap without."""
    if "learned" not in arrays:
        return None
    rho, variance = arrays.pop("learned").astype(np.float64)
    log_scale, sigma = arrays.pop("learned_scale").tolist()
    return LearnedDepths(rho, variance, log_scale, sigma)
