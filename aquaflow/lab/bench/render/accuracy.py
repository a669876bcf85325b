"""Speed means nothing for a wrong gradient: each kernel against the float64 reference."""

from __future__ import annotations

from collections.abc import Sequence

from aquaflow.render.contract import Renderer
from aquaflow.render.example_scene import NAMES, SplatScene
from aquaflow.render.parity import differences


def gradient_errors(renderers: Sequence[Renderer], scene: SplatScene) -> dict[str, float]:
    """Input -> largest relative L2 error of its gradient among ``renderers``; none: empty."""
    found = [differences(renderer, scene) for renderer in renderers]
    return {name: max(each[name] for each in found) for name in NAMES} if found else {}
