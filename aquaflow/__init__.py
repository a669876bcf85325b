"""AquaFlow: onboard mapping for underwater robots from one camera.

The functions below are the public interface; everything else may change between versions::

    dive = aquaflow.map_recording("dive.mp4", "out/dive")   # or read_dive() of one that is there
    scene = aquaflow.load_map("out/dive")
    picture = scene.render(scene.views[0].T_wc).image

    slam = aquaflow.Slam(aquaflow.Config())                 # or frame by frame
    finished = slam.process(aquaflow.Frame(0, t_ns, t_ns, image, camera))

Importing this package is cheap: torch, OpenCV and matplotlib load where they are used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aquaflow.api.export import export
    from aquaflow.api.map import Map, load_map
    from aquaflow.api.measure import measure
    from aquaflow.api.recording import map_recording
    from aquaflow.base.errors import AquaFlowError
    from aquaflow.config import Config
    from aquaflow.dive.dive import Dive, read_dive
    from aquaflow.dive.tum import Trajectory, associate, read_tum
    from aquaflow.geometry.alignment import align
    from aquaflow.geometry.camera import CameraModel, guess_camera
    from aquaflow.geometry.similarity import Sim3
    from aquaflow.slam import Slam
    from aquaflow.types import Frame

    __version__: str

__all__ = [
    "AquaFlowError",
    "CameraModel",
    "Config",
    "Dive",
    "Frame",
    "Map",
    "Sim3",
    "Slam",
    "Trajectory",
    "__version__",
    "align",
    "associate",
    "export",
    "guess_camera",
    "load_map",
    "map_recording",
    "measure",
    "read_dive",
    "read_tum",
]

_HOMES = {
    "AquaFlowError": "aquaflow.base.errors",
    "CameraModel": "aquaflow.geometry.camera",
    "Config": "aquaflow.config",
    "Dive": "aquaflow.dive.dive",
    "Frame": "aquaflow.types",
    "Map": "aquaflow.api.map",
    "Sim3": "aquaflow.geometry.similarity",
    "Slam": "aquaflow.slam",
    "Trajectory": "aquaflow.dive.tum",
    "align": "aquaflow.geometry.alignment",
    "associate": "aquaflow.dive.tum",
    "export": "aquaflow.api.export",
    "guess_camera": "aquaflow.geometry.camera",
    "load_map": "aquaflow.api.map",
    "map_recording": "aquaflow.api.recording",
    "measure": "aquaflow.api.measure",
    "read_dive": "aquaflow.dive.dive",
    "read_tum": "aquaflow.dive.tum",
}
"""The module of each public name; it is imported when the name is first used."""


def __getattr__(name: str) -> object:
    if name == "__version__":
        return _read_version()
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def _read_version() -> str:
    # Takes longer to import than all before the command line catches Ctrl-C.
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("aquaflow")
    except PackageNotFoundError:  # imported from a checkout that was never installed
        return "0+unknown"


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
