"""The live viewer's copy of a dive, made by threads that have no time for browsers.

The loop and the mapping thread put new data into queues of one; a thread of the viewer takes
it from there, computes what a browser needs, and hands it to the server.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.clear_colours import restored_gaussians
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.transfers import map_out
from aquaflow.messages import CameraModel
from aquaflow.render.activation import radiance
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


@torch.no_grad()
def copied(mapper: Mapper) -> MapCopy:
    """In the mapping thread: a copy, and two colours; a tenth of a second for 150,000."""
    tensors = mapper.gaussians.parameters
    plain = {name: map_out(tensor) for name, tensor in tensors.items()}
    clear = radiance(mapper.gaussians.parameters["raw_colours"])
    seen = clear
    view = mapper.views[-1]
    water = mapper.scene.water(view)
    if water is not None:
        z = torch.linalg.vector_norm(mapper.gaussians.means - view.centre(), dim=-1)
        seen = clear * water.transmission(z) + water.backscatter(z)
    steps = map_out(mapper.optimiser.adam.steps)
    clear = restored_gaussians(mapper.scene, clear, mapper.views)
    return MapCopy(plain, steps, map_out(seen), map_out(clear))


def shown(copy: MapCopy, budget: int) -> Splats:
    """In the viewer's thread: what a browser gets."""
    plain = copy.parameters
    often = np.log1p(copy.steps) / np.log1p(OFTEN)
    with np.errstate(over="ignore"):
        opacities = (1.0 / (1.0 + np.exp(-plain["opacity_logits"][:, 0]))).astype(np.float32)
        scales = np.exp(plain["log_scales"])
    colours = {"water": copy.seen, "clear": copy.clear, "coverage": heat(often)}
    return splats(plain["means"], plain["quats"], scales, opacities, colours, budget)
