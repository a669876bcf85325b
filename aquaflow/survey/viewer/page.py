"""One page with a scene and its tools; a slow browser never slows the caller."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from aquaflow.config.service import ViewerConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.viewer.levels import Palette
from aquaflow.survey.viewer.measuring import LengthUnit
from aquaflow.survey.viewer.moments import unknown
from aquaflow.survey.viewer.packed_file import PackedFile
from aquaflow.survey.viewer.packing import Packed
from aquaflow.survey.viewer.seen_water import SeenWater
from aquaflow.survey.viewer.server import ViewerServer
from aquaflow.survey.viewer.splats import ViewerSplats
from aquaflow.survey.viewer.tools import Tools
from aquaflow.survey.viewer.viewer_content import (
    POSE_NUMBERS,
    PathPart,
    ShownCamera,
    ShownMap,
    ViewerContent,
)
from aquaflow.types import CameraModel

Float = npt.NDArray[np.floating[Any]]

WATCHED_S = 10.0
"""After its last question a browser is gone: it asks twice a second."""
UP = {"-y": (0.0, -1.0, 0.0), "-z": (0.0, 0.0, -1.0)}


class ViewerPage:
    """A page at ``address``; everything shown replaces what was shown before."""

    def __init__(
        self,
        config: ViewerConfig,
        title: str,
        live: bool = True,
        tools: Tools | None = None,
    ) -> None:
        """Listen at once.

        Args:
            live: the page asks again and again for what is new.
            tools: what else than pointing and measuring this dive offers.

        Raises:
            InputError: the address is taken.
            ConfigError: the token will not do.
        """
        self._exhibit = ViewerContent(title, UP["-y"], live)
        self._tools = tools or Tools()
        self._tools.exhibit = self._exhibit
        self._exhibit.can = self._tools.can()
        self._server = ViewerServer(config, self._exhibit, self._tools.ask)
        host = f"[{config.host}]" if ":" in config.host else config.host
        self.address = f"http://{host}:{self._server.port}/"

    def close(self) -> None:
        self._server.close()

    @property
    def watched(self) -> bool:
        """True while a browser asks what is new."""
        return time.monotonic() - self._exhibit.asked_s < WATCHED_S

    @property
    def splats_shown(self) -> int:
        """Number of Gaussians on the page."""
        shown = self._exhibit.map
        return 0 if shown is None else shown.packed.count

    @property
    def packed(self) -> Packed | None:
        """The map as it was packed here; None of one that came packed."""
        shown = self._exhibit.map
        return shown.packed if shown is not None and isinstance(shown.packed, Packed) else None

    def show_splats(
        self,
        splats: ViewerSplats,
        water: SeenWater | None = None,
        palettes: dict[str, Palette] | None = None,
    ) -> None:
        """The map, the water before it, and the palette of each of the splats' levels."""
        self._exhibit.map = ShownMap(lambda: splats, Packed(splats), water, palettes or {})

    def show_packed(
        self,
        packed: PackedFile,
        splats: Callable[[], ViewerSplats],
        water: SeenWater | None,
        palettes: dict[str, Palette],
    ) -> None:
        """A map that was packed before; ``splats`` are its Gaussians for who points at them."""
        self._exhibit.map = ShownMap(splats, packed, water, palettes)

    def show_path(
        self,
        poses: Float,  # [N, 8] place, rotation wxyz from the camera, quality in [0, 1]
        moments: Float | None = None,  # [N, 5] as aquaflow/survey/viewer/moments.py has them
        began: datetime | None = None,
        parts: Sequence[PathPart] = (),
    ) -> None:
        """The trajectory, with how well each pose is known, and what else is known of its moments;
        ``began``: UTC of the first one; ``parts``: of several dives, whose seconds each begin at
        0."""
        rows = np.asarray(poses, np.float32).reshape(-1, POSE_NUMBERS)
        said = unknown(len(rows)) if moments is None else np.asarray(moments, np.float32)
        self._exhibit.path = np.concatenate([rows, said], axis=1)
        self._exhibit.began, self._exhibit.path_parts = began, tuple(parts)
        self._exhibit.path_number += 1

    def show_camera(
        self,
        T_wc: Sim3,
        camera: CameraModel,
        picture: npt.NDArray[np.uint8] | None,  # [H, W, 3] RGB
    ) -> None:
        """The camera where it is, with what it sees."""
        before = self._exhibit.camera
        number = 0 if before is None else before.number + 1
        self._exhibit.camera = ShownCamera(T_wc, camera, picture, number)

    def show_pictures(self, pictures: Mapping[int, Path]) -> None:
        """What the camera saw, by the frame's index, where that is kept."""
        self._exhibit.pictures = pictures

    def show_health(self, text: str) -> None:
        """The panel's text: paragraphs."""
        self._exhibit.health = text

    def set_frame(self, frame: LengthUnit, up: Literal["-y", "-z"] = "-y", north: str = "") -> None:
        """The unit of lengths, how well it is known, and which axis of the world points up: by
        default the first camera's, whose y points down. ``north``: what headings begin at."""
        self._exhibit.north = north
        self._tools.frame = frame
        self._exhibit.unit, self._exhibit.metres = frame.scale.unit, frame.metres
        self._exhibit.up = UP[up]
