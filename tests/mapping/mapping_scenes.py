"""Small maps with a known answer: Gaussians before a small camera, and pictures drawn of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.config import MappingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.keyframes import Pointmap
from aquaflow.mapping.gaussians import GaussianMap, raw_colour
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.scene import Scene, show
from aquaflow.mapping.scene_water import adopt_water, fitting_water
from aquaflow.render import select_renderer
from aquaflow.render.contract import Renderer
from aquaflow.render.views import View
from aquaflow.water.estimation import WaterEstimate
from aquaflow.water.medium import WaterParameters
from aquaflow.water.observations import run_to_end

Array = npt.NDArray[np.float64]

CAMERA = CameraModel(64, 48, 55.0, 55.0, 32.0, 24.0)
FLOOR_M = 2.0
"""Distance of the floor from the first camera."""


def renderer(threads: int = 1) -> Renderer:
    return select_renderer("auto", threads)


def pose(
    translation: tuple[float, float, float], rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Sim3:
    return Sim3(so3_exp(np.array(rotation)), np.array(translation))


def gaussians_at(
    means: Tensor,  # [N, 3]
    colours: Tensor,  # [N, 3]
    scale: float,
    opacity: float = 0.9,
) -> GaussianMap:
    """Round Gaussians, all alike but for place and colour."""
    count, gaussians = len(means), GaussianMap()
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1.0
    new = {
        "means": means.to(torch.float32),
        "quats": quats,
        "log_scales": torch.full((count, 3), math.log(scale)),
        "opacity_logits": torch.full((count, 1), math.log(opacity / (1.0 - opacity))),
        "raw_colours": raw_colour(colours.to(torch.float32)),
    }
    gaussians.extend(new, keyframe=0)
    return gaussians


def cloud(seed: int = 0, count: int = 200) -> GaussianMap:
    """Gaussians of random colours, 1.5 to 3 m before the camera at the origin."""
    rng = torch.Generator().manual_seed(seed)
    depth = 1.5 + 1.5 * torch.rand(count, 1, generator=rng)
    across = (torch.rand(count, 2, generator=rng) - 0.5) * torch.tensor([1.2, 0.9])
    means = torch.cat([across, torch.ones(count, 1)], 1) * depth
    return gaussians_at(means, torch.rand(count, 3, generator=rng), 0.08)


def floor(seed: int = 0, columns: int = 20, rows: int = 15, scale: float = 0.09) -> GaussianMap:
    """A flat floor that fills the first camera's picture, of random colours."""
    rng = torch.Generator().manual_seed(seed)
    x = torch.linspace(-1.4, 1.4, columns)
    y = torch.linspace(-1.05, 1.05, rows)
    grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)
    means = torch.cat([grid, torch.full((len(grid), 1), FLOOR_M)], 1)
    return gaussians_at(means, 0.1 + 0.8 * torch.rand(len(grid), 3, generator=rng), scale)


def picture(
    gaussians: GaussianMap,
    T_wc: Sim3,
    water: WaterParameters | None = None,
    camera: CameraModel = CAMERA,
) -> npt.NDArray[np.uint8]:
    """[H, W, 3] what a camera at ``T_wc`` sees of them."""
    blank = view_of(np.zeros((camera.height, camera.width, 3), np.uint8), T_wc, camera=camera)
    with torch.no_grad():
        shown = show(gaussians.parameters, water, None, renderer(), blank, blank.viewmat())
    return (shown.image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()


def view_of(
    image: npt.NDArray[np.uint8],  # [H, W, 3]
    T_wc: Sim3 | None = None,
    index: int = 0,
    robust: bool = False,
    camera: CameraModel = CAMERA,
) -> View:
    return View(index, image, camera, T_wc or Sim3.identity(), keyframe=0, robust=robust)


def path(count: int) -> list[Sim3]:
    """Poses that sway over the floor."""
    return [
        pose((0.06 * i, 0.05 * math.sin(i), 0.04 * math.cos(2.0 * i) - 0.04), (0.0, 0.01 * i, 0.0))
        for i in range(count)
    ]


def filmed(
    gaussians: GaussianMap, poses: list[Sim3], water: WaterParameters | None = None
) -> list[View]:
    return [view_of(picture(gaussians, T, water), T, i) for i, T in enumerate(poses)]


def flat_pointmap(
    depth: float = FLOOR_M, relative_sigma: float = 0.01, camera: CameraModel = CAMERA
) -> Pointmap:
    """Every pixel at one depth along the optical axis."""
    rho = np.full((camera.height, camera.width), 1.0 / depth)
    return Pointmap(camera, rho, (relative_sigma * rho) ** 2)


def water(
    beta: float = 0.2, B_inf: float = 0.3, b: float = 0.25, B_res: float = 0.01
) -> WaterParameters:
    """Water that differs a little from channel to channel."""
    tint = torch.tensor([1.5, 1.0, 0.8])
    return WaterParameters(
        beta * tint,
        B_inf / tint,
        b * tint,
        torch.full((3,), B_res),
        torch.ones(3),
    )


def settings(**stages: dict[str, Any]) -> MappingConfig:
    """A config with some keys of some stages changed; without water unless it is asked for."""
    stages.setdefault("medium", {"enabled": False})
    return MappingConfig.model_validate(stages)


def grown(config: MappingConfig, seed: int = 0, count: int = 4, threads: int = 1) -> Mapper:
    """A mapper that has seen ``count`` pictures of the floor and inserted from the first."""
    mapper = Mapper(config, renderer(threads), seed)
    for view in filmed(floor(), path(count)):
        mapper.add_view(view)
    mapper.insert(mapper.views[0], flat_pointmap())
    return mapper


def error(mapper: Mapper) -> float:
    """Mean absolute difference between the map and the pictures."""
    parts = [(mapper.show(view).image - view.target()).abs().mean() for view in mapper.views]
    return float(torch.stack(parts).mean())


def copied(mapper: Mapper) -> dict[str, Tensor]:
    """All that makes up the map: Gaussians and medium."""
    return {
        **{name: tensor.clone() for name, tensor in mapper.gaussians.parameters.items()},
        **{name: tensor.clone() for name, tensor in mapper.medium.state_dict().items()},
    }


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    """Bit for bit."""
    return all(torch.equal(a[name], b[name]) for name in a)


def fit_water(
    scene: Scene, views: list[View], generator: torch.Generator, dive: list[View] | None = None
) -> WaterEstimate | None:
    """The whole fit, its pauses left out; adopted for all views of the dive."""
    estimate, fitted = run_to_end(fitting_water(scene, views, generator))
    if estimate is not None:
        adopt_water(scene, estimate, fitted, views if dive is None else dive)
    return estimate
