"""What tracked frames contribute to the maps: views, some held out, and retired keyframes."""

from __future__ import annotations

from collections.abc import Callable

from aquaflow.config import MappingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.keyframes import KeyframeStore
from aquaflow.mapping.work import Growth, Insertion, MapWork
from aquaflow.render.views import View
from aquaflow.telemetry.metric_frame import MetricFrame
from aquaflow.tracking.frames import FrameClass, Tracked


class Contributions:
    """Hands posed frames to the maps."""

    def __init__(
        self,
        maps: MapWork,
        keyframes: KeyframeStore,
        config: MappingConfig,
        frame_of: Callable[[int], MetricFrame],
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
        """Hold a posed frame out, or let its map grow by it."""
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
        for insertion in self._retired():
            self._maps.insert(insertion)

    def _growth(self, tracked: Tracked, view: View) -> Growth:
        """What the frame brings to the map; a new keyframe also retires the one before it."""
        retired: list[Insertion] = []
        if tracked.frame_class is FrameClass.KEYFRAME:
            retired = self._retired()
            self._views = {view.keyframe: view}
        steps = self._steps(tracked.frame_class)
        frame = self._frame_of(tracked.sub_map)
        unit = frame.T_nm.scale if frame.metric else None
        return Growth(view, tracked.sub_map, steps, tracked.pointmap, tuple(retired), unit)

    def _retired(self) -> list[Insertion]:
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
