"""AquaFlow: onboard mapping for underwater robots from one camera.

The functions below are the public interface; everything else may change between versions::

    dive = aquaflow.map_recording("dive.mp4", "out/dive")   # or read_dive() of one that is there
    scene = aquaflow.load_map("out/dive")
    picture = scene.render(scene.views[0].T_wc).image

Importing this package is cheap: torch, OpenCV and matplotlib load where they are used.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aquaflow.api.map import Map, load_map
    from aquaflow.api.recording import map_recording
    from aquaflow.base.errors import AquaFlowError
    from aquaflow.dive.dive import Dive, read_dive

try:
    __version__ = version("aquaflow")
except PackageNotFoundError:  # imported from a checkout that was never installed
    __version__ = "0+unknown"

__all__ = [
    "AquaFlowError",
    "Dive",
    "Map",
    "__version__",
    "load_map",
    "map_recording",
    "read_dive",
]

_HOMES = {
    "AquaFlowError": "aquaflow.base.errors",
    "Dive": "aquaflow.dive.dive",
    "Map": "aquaflow.api.map",
    "load_map": "aquaflow.api.map",
    "map_recording": "aquaflow.api.recording",
    "read_dive": "aquaflow.dive.dive",
}
"""The module of each public name; it is imported when the name is first used."""


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
