"""What is shown at the moment, for the threads of the server; everything is packed when asked for.

The thread that shows replaces whole objects and never waits; a browser gets what is there when it
asks. Where no browser asks, nothing is packed.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import reason_of
from aquaflow.base.errors.regular_file import read_regular
from aquaflow.dive.png import read_png
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.viewer.levels import Palette
from aquaflow.survey.viewer.moments import MOMENT_NUMBERS
from aquaflow.survey.viewer.packing import Packed, PackedFile
from aquaflow.survey.viewer.seen_water import SeenWater
from aquaflow.survey.viewer.splats import ViewerSplats
from aquaflow.types import CameraModel

Float = npt.NDArray[np.floating[Any]]

log = logging.getLogger(__name__)

JPEG_QUALITY = 80
POSE_NUMBERS = 8
"""Of each pose: place, rotation wxyz, quality."""
PATH_NUMBERS = POSE_NUMBERS + MOMENT_NUMBERS
"""Of each row of the path."""


@dataclass(frozen=True)
class ShownMap:
    """Gaussians with what is needed to see them."""

    splats: Callable[[], ViewerSplats]
    """For who points at them; may take seconds when it is first called."""
    packed: Packed | PackedFile
    water: SeenWater | None
    palettes: dict[str, Palette]


@dataclass(frozen=True)
class ShownCamera:
    """A camera with what it sees."""

    T_wc: Sim3
    camera: CameraModel
    picture: npt.NDArray[np.uint8] | None
    """[H, W, 3] RGB"""
    number: int
    """Counts the cameras shown."""


@dataclass(frozen=True)
class PathPart:
    """Poses that follow each other, of one dive among several."""

    name: str
    """Of the dive."""
    first: int
    """Number of its first pose in the path."""
    began: datetime | None
    """UTC of that pose; None where nothing stated it."""
    camera: CameraModel

    def to_json(self) -> dict[str, Any]:
        """The part by the names that the page uses."""
        began = None if self.began is None else self.began.isoformat()
        return {"name": self.name, "first": self.first, "began": began, **_optics(self.camera)}


@dataclass
class ViewerContent:
    """Attributes are replaced as a whole; they are not changed in place."""

    title: str
    up: tuple[float, float, float]
    live: bool = True
    health: str = ""
    unit: str = "map units"
    metres: float = 1.0
    """Of ``unit``, in a unit of the coordinates."""
    map: ShownMap | None = None
    path: npt.NDArray[np.float32] = field(
        default_factory=lambda: np.zeros((0, PATH_NUMBERS), np.float32)
    )
    """[N, 13] of each pose, place, rotation and quality, and its moment."""
    path_parts: tuple[PathPart, ...] = ()
    """Where poses of several dives follow each other."""
    path_number: int = 0
    camera: ShownCamera | None = None
    pictures: Mapping[int, Path] = field(default_factory=dict)
    """What the camera saw, by the frame's index."""
    began: datetime | None = None
    """UTC of the first pose; None where nothing stated it."""
    north: str = ""
    """What headings are counted from."""
    can: tuple[str, ...] = ()
    """Tools that this dive offers beyond measuring: ``note``, ``view``, ``scale``."""
    asked_s: float = -math.inf
    """When a browser last asked for the scene, s of the monotonic clock."""
    _jpeg: tuple[int, bytes] = (-1, b"")
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def scene(self) -> dict[str, Any]:
        """What the page asks for first, and again and again while the dive goes on."""
        shown, camera = self.map, self.camera
        self.asked_s = time.monotonic()
        said: dict[str, Any] = {
            "title": self.title, "up": self.up, "live": self.live, "health": self.health,
            "unit": self.unit, "metres": self.metres, "can": self.can, "map": None, "camera": None,
            "path": {
                "number": self.path_number, "count": len(self.path),
                "parts": [part.to_json() for part in self.path_parts],
            },
            "began": None if self.began is None else self.began.isoformat(), "north": self.north,
        }  # fmt: skip
        if shown is not None and shown.packed.count:
            water = None if shown.water is None else shown.water.to_json()
            palettes = {name: each.to_json() for name, each in shown.palettes.items()}
            said["map"] = shown.packed.description() | {"water": water, "palettes": palettes}
        if camera is not None:
            said["camera"] = {
                "number": camera.number, "place": camera.T_wc.t.tolist(),
                "wxyz": camera.T_wc.quaternion.tolist(), **_optics(camera.camera),
                "picture": camera.picture is not None,
            }  # fmt: skip
        return said

    def chunk(self, version: str, number: int) -> bytes | None:
        """Gzipped, of the map of that version; None if another one is shown by now."""
        shown = self.map
        if shown is None or shown.packed.version != version:
            return None
        return shown.packed.chunk(number)

    def tile(self, version: str, number: int, part: int) -> bytes | None:
        """Gzipped part of a tile, of the map of that version; None where there is none."""
        shown = self.map
        if shown is None or shown.packed.version != version or shown.packed.tiles is None:
            return None
        return shown.packed.tiles.part(number, part)

    def picture(self, index: int) -> bytes | None:
        """JPEG of what the camera saw at a frame; None where nothing is kept."""
        path = self.pictures.get(index)
        if path is None:
            return None
        try:
            if path.suffix == ".jpg":
                return read_regular(path, folders=1)
            shown = read_png(path, folders=1)
            return _jpeg(shown if shown.ndim == 2 else shown[..., 2::-1])
        except FileNotFoundError:  # thinned meanwhile
            return None
        except (OSError, ValueError, IndexError) as error:
            log.warning("%s is not shown: %s", path, reason_of(error))
            return None

    def newest_picture(self) -> bytes | None:
        """JPEG of what the camera sees; encoded once for all browsers."""
        camera = self.camera
        if camera is None or camera.picture is None:
            return None
        with self._lock:
            if self._jpeg[0] != camera.number:
                self._jpeg = camera.number, _jpeg(camera.picture[..., ::-1]) or b""
            return self._jpeg[1]


def _optics(camera: CameraModel) -> dict[str, float]:
    return {
        "width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy,
        "cx": camera.cx, "cy": camera.cy,
    }  # fmt: skip


def _jpeg(
    image: npt.NDArray[Any] | None,  # [H, W, 3] BGR
) -> bytes | None:
    if image is None:
        return None
    import cv2

    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes() if done else None
