"""The maps of a dive, and what tracked frames bring to them: views, some held out, and keyframes.

With mapping off neither is loaded: both need torch, 100 MB that tracking alone has no use for.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from aquaflow.base.stages import Stages
from aquaflow.config import Config, MappingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.keyframes import KeyframeStore
from aquaflow.mapping.work import Growth, Insertion, MapWork, NoMaps, OwnedMaps
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.frames import FrameClass, Tracked

if TYPE_CHECKING:
    from aquaflow.render.views import View


def make_maps(
    config: Config,
    stages: Stages,
    work: Path | None,
    enabled: bool,
    threads: int | None = None,
) -> OwnedMaps:
    """Maps that are drawn in ``threads`` (None: as many as the config says, or the machine has);
    none of them where they are not ``enabled``."""
    if not enabled:
        return NoMaps(stages.profiler, stages.failures)
    from aquaflow.mapping.maps import Maps
    from aquaflow.render import select_renderer

    count = threads or config.threads or os.cpu_count()
    renderer = select_renderer(config.mapping.renderer, count)
    return Maps(config, renderer, stages.profiler, work, stages.failures)


class MapInputs:
    """Hands posed frames to the maps; to none with mapping off."""

    def __init__(
        self,
        maps: MapWork,
        keyframes: KeyframeStore,
        config: MappingConfig,
        frame_of: Callable[[int], WorldFrame],
    ) -> None:
        """``frame_of`` a sub-map, as last estimated."""
        self._maps, self._keyframes, self._config = maps, keyframes, config
        self._frame_of = frame_of
        self._to_hold_out: set[int] = set()
        """Indices of the frames in tracking that the map shall not see."""
        self._views: dict[int, View] = {}
        """Of the keyframe in use, by its number."""

    def expect(self, index: int, i: int) -> None:
        """Frame ``index`` goes into tracking; it is decided here whether it is held out.

        i % n == 0 and i != 0, ``i`` counts used frames (docs/paper.md#deviations-evaluation).
        """
        every = self._config.hold_out_every
        if every > 0 and i != 0 and i % every == 0:
            self._to_hold_out.add(index)

    def add(self, tracked: Tracked, camera: CameraModel) -> None:
        """Hold a frame that has a pose out, or let its map grow by it."""
        if not self._config.enabled or tracked.T_wc is None:
            return
        view = _view(tracked, camera)
        if tracked.frame.index in self._to_hold_out:
            self._maps.hold_out(view, tracked.sub_map)
        else:
            self._maps.grow(self._growth(tracked, view))

    def forget(self, index: int) -> None:
        """Frame ``index`` is finished."""
        self._to_hold_out.discard(index)

    def retire_last(self) -> None:
        """After the last frame: insert the keyframe in use, with its depths as they are now."""
        for insertion in self._retire():
            self._maps.insert(insertion)

    def _growth(self, tracked: Tracked, view: View) -> Growth:
        """What the frame brings to the map; a new keyframe also retires the one before it."""
        retired: list[Insertion] = []
        if tracked.frame_class is FrameClass.KEYFRAME:
            retired = self._retire()
            self._views = {view.keyframe: view}
        steps = self._steps(tracked.frame_class)
        frame = self._frame_of(tracked.sub_map)
        unit = frame.T_nm.scale if frame.metric else None
        return Growth(view, tracked.sub_map, steps, tracked.pointmap, tuple(retired), unit)

    def _retire(self) -> list[Insertion]:
        """The keyframe in use, with its pointmap as fused until now; from here on it is not."""
        retired, self._views = self._views, {}
        keyframes = self._keyframes
        return [
            Insertion(view, keyframes[number].sub_map, keyframes[number].pointmap)
            for number, view in retired.items()
        ]

    def _steps(self, frame_class: FrameClass) -> int:
        optimiser = self._config.optimiser
        return {
            FrameClass.KEYFRAME: optimiser.steps_keyframe,
            FrameClass.MAPPING: optimiser.steps_mapping,
        }.get(frame_class, optimiser.steps_common)


def _view(tracked: Tracked, camera: CameraModel) -> View:
    from aquaflow.render.views import View

    assert tracked.T_wc is not None
    assert tracked.keyframe is not None
    return View(
        tracked.frame.index,
        tracked.frame.image,
        camera,
        tracked.T_wc,
        tracked.keyframe,
        robust=tracked.frame_class is FrameClass.COMMON,
        mask=tracked.frame.mask,
    )
