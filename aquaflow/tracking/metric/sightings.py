"""Where objects of known size were seen in a dive, with what measuring them in the map needs."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.config import FusionConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.telemetry.known_lengths.board_size import BoardView, PixelDepths
from aquaflow.telemetry.known_lengths.finder import KnownLengthFinder
from aquaflow.telemetry.known_lengths.known_length import KnownLength
from aquaflow.telemetry.world_frame import SourceReport

Array = npt.NDArray[np.float64]
PlaceOf = Callable[[int], tuple[Sim3, int] | None]
"""T_wc and the component of a frame by its index; None for a frame without a pose."""


@dataclass(frozen=True)
class SeenLengths:
    """Objects of known size in one sub-map."""

    lengths: list[KnownLength]
    unknown: list[SourceReport]
    """Of objects that were seen, but could not be measured."""


class LengthSightings:
    """Grows with the pictures; a kilobyte for each that shows something."""

    def __init__(self, config: FusionConfig) -> None:
        self.looks_for = bool(config.enabled and (config.boards or config.lasers))
        """True if the settings name an object."""
        self._finder = KnownLengthFinder(config)
        self._cameras: dict[int, CameraModel] = {}
        self._pixels: dict[int, Array] = {}
        self._depths: dict[int, PixelDepths] = {}

    def __bool__(self) -> bool:
        return bool(self._finder)

    def look(
        self,
        frame_index: int,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB, undistorted
        camera: CameraModel,
    ) -> None:
        """Look for the objects in a picture: some milliseconds for each."""
        pixels = self._finder.look(frame_index, image)
        if len(pixels):
            self._cameras[frame_index], self._pixels[frame_index] = camera, pixels

    def keep_depths(self, frame_index: int, pointmap: Callable[[], Pointmap]) -> None:
        """Keep a keyframe's depths where something was seen in it."""
        pixels = self._pixels.get(frame_index)
        if pixels is not None:
            found = pointmap()
            view = BoardView(found.camera, Sim3.identity(), 0, found.rho, found.variance)
            self._depths[frame_index] = PixelDepths(pixels, *view.depth_at(pixels))

    def copy(self) -> LengthSightings:
        """What was seen until now, to be measured by another thread."""
        other = copy(self)
        other._finder = self._finder.copy()
        other._cameras, other._depths = dict(self._cameras), dict(self._depths)
        return other

    def measure(self, place_of: PlaceOf) -> dict[int, SeenLengths]:
        """What was seen, by component, measured with the poses of now."""

        def view_of(frame_index: int) -> BoardView | None:
            place, camera = place_of(frame_index), self._cameras.get(frame_index)
            if place is None or camera is None:
                return None
            return BoardView(camera, *place, depths=self._depths.get(frame_index))

        lengths = self._finder.lengths(view_of)
        known = {(length.sub_map, length.source) for length in lengths}
        seen = self._finder.count_seen(view_of)
        found = {component: SeenLengths([], []) for component, _ in seen}
        for length in lengths:
            found[length.sub_map].lengths.append(length)
        for (component, name), pictures in seen.items():
            if (component, name) not in known:
                reason = f"its size does not follow from the pictures that show it ({pictures})"
                found[component].unknown.append(SourceReport(name, "length", reason=reason))
        return found
