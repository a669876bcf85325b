"""The parts of a dive that belong to its maps; with mapping off they are neither made nor loaded.

They load torch: 100 MB that tracking alone has no use for.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from aquaflow.base.errors.failures import Failures
from aquaflow.base.profiler import Profiler
from aquaflow.config import Config
from aquaflow.keyframes import KeyframeStore
from aquaflow.mapping.no_maps import NoMaps
from aquaflow.mapping.work import MapWork, OwnedMaps
from aquaflow.telemetry.metric_frame import MetricFrame

if TYPE_CHECKING:
    from aquaflow.slam.contributions import Contributions


def make_maps(
    config: Config,
    profiler: Profiler,
    work: Path | None,
    failures: Failures,
    enabled: bool,
    threads: int | None = None,
) -> OwnedMaps:
    """Maps that are drawn in ``threads`` (None: as many as the config says, or the machine has);
    none of them where they are not ``enabled``."""
    if not enabled:
        return NoMaps(profiler, failures)
    from aquaflow.mapping.maps import Maps
    from aquaflow.render import select_renderer

    renderer = select_renderer(
        config.mapping.renderer, threads or config.threads or os.cpu_count()
    )  # fmt: skip
    return Maps(config, renderer, profiler, work, failures)


def make_contributions(
    config: Config,
    maps: MapWork,
    keyframes: KeyframeStore,
    frame_of: Callable[[int], MetricFrame],
) -> Contributions | None:
    """What hands posed frames to ``maps``; None with mapping off. ``frame_of`` a sub-map."""
    if not config.mapping.enabled:
        return None
    from aquaflow.slam.contributions import Contributions

    return Contributions(maps, keyframes, config.mapping, frame_of)
