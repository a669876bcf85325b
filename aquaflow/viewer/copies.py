"""The live viewer's copy of a dive, made by threads that have no time for browsers.

The loop and the mapping thread put new data into queues of one; a thread of the viewer takes
it from there, computes what a browser needs, and hands it to the server.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3
from aquaflow.messages import CameraModel
from aquaflow.viewer.splats import Splats, heat, splats

OFTEN = 200.0
"""Steps of the optimiser after which a Gaussian counts as seen as often as can be."""


@dataclass(frozen=True)
class Pose:
    """Where the camera is, and what it sees."""

    T_wc: Sim3
    camera: CameraModel
    picture: npt.NDArray[np.uint8]
    """[H, W, 3] RGB"""
    path: npt.NDArray[np.float32]
    """[N, 4] centres of the cameras so far, and how well each is known."""


@dataclass(frozen=True)
class MapCopy:
    """Copies of the shown parts of a map, which mapping changes meanwhile."""

    parameters: dict[str, npt.NDArray[np.float32]]
    steps: npt.NDArray[np.int32]
    """[N] optimiser steps of each Gaussian."""
    seen: npt.NDArray[np.float32]
    """[N, 3] as the last camera sees it."""
    clear: npt.NDArray[np.float32]
    """[N, 3] without water."""


def shown(copy: MapCopy, budget: int) -> Splats:
    """In the viewer's thread: what a browser gets."""
    plain = copy.parameters
    often = np.log1p(copy.steps) / np.log1p(OFTEN)
    with np.errstate(over="ignore"):
        opacities = (1.0 / (1.0 + np.exp(-plain["opacity_logits"][:, 0]))).astype(np.float32)
        scales = np.exp(plain["log_scales"])
    colours = {"water": copy.seen, "clear": copy.clear, "coverage": heat(often)}
    return splats(plain["means"], plain["quats"], scales, opacities, colours, budget)
