"""One view of the scene: exact ranges and antialiased clean and underwater colours."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.optics import rays_of_pixels
from aquaflow.lab.synthetic import objects
from aquaflow.lab.synthetic.config import Lamps
from aquaflow.lab.synthetic.lamps import SyntheticLampLight
from aquaflow.lab.synthetic.march import RayHeightField
from aquaflow.lab.synthetic.radiance import TEXELS_PER_CELL
from aquaflow.lab.synthetic.relief import Area
from aquaflow.lab.synthetic.texture import MipAtlas
from aquaflow.lab.synthetic.water import Medium

Array: TypeAlias = npt.NDArray[np.float64]
Met: TypeAlias = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]
"""Origins [3] or [3, N], rays [3, N], their ranges [N] and what they hit [N] (-1 floor)."""

BUNDLE = 4
"""Rays along the side of a bundle in the first pass."""
CHUNK_RAYS = 60_000
"""Rays that are worked on together: small enough to stay in the cache."""


@dataclass(frozen=True)
class SyntheticScene:
    """Everything that a ray can meet."""

    area: Area
    field: RayHeightField
    floor: MipAtlas
    """Radiance of the floor over the area, and its steepness (radiance.bake)."""
    shapes: list[objects.Solid]
    object_texture: MipAtlas
    max_range_m: float


@dataclass(frozen=True)
class RenderedView:
    """What one pose sees."""

    range_m: npt.NDArray[np.float32]
    """[H, W] m along the ray of the pixel's centre, behind a port from where the water begins; inf
    where nothing is hit."""
    clean: npt.NDArray[np.float32]
    """[H, W, 3] radiance J, mean over the pixel; 0 where nothing is hit."""
    water: npt.NDArray[np.float32]
    """[H, W, 3] colour through the water, mean over the pixel."""
    moving: npt.NDArray[np.bool_]
    """[H, W] the pixel's centre sees one of ``bodies``."""


def render(
    scene: SyntheticScene,
    camera: CameraModel,
    R_sc: Array,  # [3, 3] camera axes in the survey frame (z down)
    centre: Array,  # [3] m, survey frame (z down)
    medium: Medium,
    supersampling: int,
    bodies: Sequence[objects.Solid] = (),
    lamps: Lamps | None = None,
) -> RenderedView:
    """Render with ``supersampling`` x ``supersampling`` rays per pixel, more where a net's twine
    needs them; ``bodies`` move by themselves, and are where they are now."""
    still = len(scene.shapes)
    scene = replace(scene, shapes=[*scene.shapes, *bodies])
    up = np.diag([1.0, 1.0, -1.0])
    rotation, origin = up @ R_sc, torch.tensor(up @ centre, dtype=torch.float32)
    height, width = camera.height, camera.width
    view = RenderedView(
        np.empty((height, width), np.float32),
        np.empty((height, width, 3), np.float32),
        np.empty((height, width, 3), np.float32),
        np.empty((height, width), np.bool_),
    )
    k = max(supersampling, _rays_for_twine(scene.shapes, camera, up @ centre))
    rows = max(1, CHUNK_RAYS // (width * k**2))
    light = None
    if lamps is not None:
        light = SyntheticLampLight.of_camera(lamps, medium, rotation, origin.numpy())

    def draw(top: int) -> None:
        part = slice(top, min(top + rows, height))
        met = _ranges(scene, camera, rotation, origin, part, k)
        J = _trace(scene, camera, met, part, k)
        view.clean[part] = _pixel_mean(J, k)
        t, what = met[2:]
        if light is None:
            colours = medium.compose(J, t.reshape(J.shape[:2]).numpy())
        else:
            colours = _lit(scene, light, met, J)
        view.water[part] = _pixel_mean(colours, k)
        if k > 1:
            t, what = _ranges(scene, camera, rotation, origin, part, 1)[2:]
        view.range_m[part] = t.reshape(-1, width).numpy()
        view.moving[part] = what.reshape(-1, width).numpy() >= still

    # Each worker computes alone: parts need not wait for each other inside every operation, and
    # the result does not depend on the number of threads.
    threads, workers = torch.get_num_threads(), os.cpu_count() or 1
    try:
        with ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            list(pool.map(draw, range(0, height, rows)))
    finally:
        torch.set_num_threads(threads)
    return view


def _rays_for_twine(
    shapes: Sequence[objects.Solid],
    camera: CameraModel,
    centre: Array,  # [3] of the camera, m
) -> int:
    """Rays along a pixel's side that are no further apart, on any net straight ahead, than its
    twine is thick: fewer hit twine here and there by chance, and what a picture then shows is a
    pattern that no camera sees and that moves unlike the net."""
    count = 1
    for net in (shape for shape in shapes if shape.kind == "net"):
        distance = abs(float(net.R[:, 2] @ (centre - net.centre)))
        count = max(count, math.ceil(distance / (camera.fx * net.twine_m)))
    return count


def _pixel_mean(
    values: npt.NDArray[np.floating],  # [k H, k W, 3]
    k: int,
) -> npt.NDArray[np.floating]:
    """Mean of k x k subsamples, [k H, k W, 3] -> [H, W, 3]."""
    total = np.zeros_like(values[::k, ::k])
    for i in range(k):
        for j in range(k):
            total += values[i::k, j::k]
    return np.asarray(total / np.float32(k * k))


def _rays(
    camera: CameraModel,
    rotation: Array,  # [3, 3] camera to the area's axes, z up
    centre: torch.Tensor,  # [3] m
    rows: Array,  # [R] px
    columns: Array,  # [C] px
) -> tuple[torch.Tensor, torch.Tensor]:
    """Origins [3] or [3, R * C] (m) and unit vectors [3, R * C] (z up) of pixels rows x columns."""
    if not camera.is_pinhole:
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        origins, bent = (rotation @ each.T for each in rays_of_pixels(camera, pixels))
        start = centre[:, None].double() + torch.from_numpy(origins)
        return start.float(), torch.from_numpy(bent).float()
    x = torch.tensor((columns - camera.cx) / camera.fx, dtype=torch.float32)[None, :]
    y = torch.tensor((rows - camera.cy) / camera.fy, dtype=torch.float32)[:, None]
    inverse = torch.rsqrt(x * x + y * y + 1.0)
    r = rotation.tolist()
    parts = [(r[k][0] * x + r[k][1] * y + r[k][2]) * inverse for k in range(3)]
    return centre, torch.stack([part.reshape(-1) for part in parts])


def _ranges(
    scene: SyntheticScene,
    camera: CameraModel,
    rotation: Array,  # [3, 3]
    centre: torch.Tensor,  # [3] m
    part: slice,
    k: int,
) -> Met:
    """What k x k rays a pixel meet."""
    rows = part.start + (np.arange((part.stop - part.start) * k) + 0.5) / k
    columns = (np.arange(camera.width * k) + 0.5) / k
    origin, rays = _rays(camera, rotation, centre, rows, columns)
    pixel = 1.0 / (camera.fx * k)
    tall, wide = math.ceil(len(rows) / BUNDLE), math.ceil(len(columns) / BUNDLE)
    middle_rows = part.start + (np.arange(tall) + 0.5) * BUNDLE / k
    middle_columns = (np.arange(wide) + 0.5) * BUNDLE / k
    of_bundle, bundles = _rays(camera, rotation, centre, middle_rows, middle_columns)
    spread = pixel * BUNDLE / math.sqrt(2.0)
    start = scene.field.bundle_start(of_bundle, bundles, spread, scene.max_range_m)
    start = start.reshape(tall, wide).repeat_interleave(BUNDLE, 0).repeat_interleave(BUNDLE, 1)
    start = start[: len(rows), : len(columns)].reshape(-1)
    t = scene.field.hit(origin, rays, start, pixel, scene.max_range_m)
    what = torch.full(t.shape, -1)
    axes, angle = bundles, spread
    for index, shape in enumerate(scene.shapes):
        if not _may_meet(shape, of_bundle, axes, angle):
            continue
        met = objects.hit(shape, origin, rays)
        nearer = (met < t) & (met < scene.max_range_m)
        t = torch.where(nearer, met, t)
        what = torch.where(nearer, index, what)
    return origin, rays, t, what


def _may_meet(
    shape: objects.Solid,
    origin: torch.Tensor,  # [3] m, or [3, N] of each ray
    axes: torch.Tensor,  # [3, N] unit vectors
    spread: float,
) -> bool:
    """False if no ray within ``spread`` of ``axes`` [3, N] passes the shape's ball."""
    to = torch.tensor(shape.centre, dtype=torch.float32)[:, None] - origin.reshape(3, -1)
    along = to[0] * axes[0] + to[1] * axes[1] + to[2] * axes[2]
    aside = ((to * to).sum(0) - along * along).clamp_min(0.0).sqrt()
    return bool(((aside < shape.reach + 2.0 * spread * along.abs()) & (along > -shape.reach)).any())


def _trace(
    scene: SyntheticScene,
    camera: CameraModel,
    met: Met,  # of N rays: [3] or [3, N], [3, N], [N], [N]
    part: slice,
    k: int,
) -> npt.NDArray[np.float32]:
    """Clean radiances [k R, k W, 3] of all rays of some rows."""
    origin, rays, t, what = met
    pixel = 1.0 / (camera.fx * k)
    shape = ((part.stop - part.start) * k, camera.width * k)
    near = torch.where(t.isfinite(), t, 0.0)
    x, y = origin[0] + near * rays[0], origin[1] + near * rays[1]
    texel = scene.area.cell / TEXELS_PER_CELL
    footprint = _footprint(x.reshape(shape), y.reshape(shape)).reshape(-1) / texel
    J = scene.floor.sample((x - scene.area.x0) / texel, (y - scene.area.y0) / texel, footprint)
    J, steep = J[:3], J[3]
    which = ((steep > 0.05) & (what < 0)).nonzero()[:, 0]
    z = _pick(origin, which)[2] + near[which] * rays[2, which]
    J[:, which] *= 1.0 + steep[which] * _grain(scene, x[which], y[which], z, near[which] * pixel)
    for index in np.unique(what.numpy()).tolist():
        if index < 0:
            continue
        which = (what == index).nonzero()[:, 0]
        J[:, which] = objects.radiance(
            scene.shapes[index],
            scene.object_texture,
            _pick(origin, which),
            rays[:, which],
            t[which],
            pixel,
        )
    J = torch.where(t.isfinite(), J.clamp_max(0.98), 0.0)
    return J.reshape(3, *shape).permute(1, 2, 0).numpy()


def _lit(
    scene: SyntheticScene,
    light: SyntheticLampLight,
    met: Met,  # of N rays: [3] or [3, N], [3, N], [N], [N]
    J: npt.NDArray[np.float32],  # [k R, k W, 3]
) -> npt.NDArray[np.floating]:
    """[k R, k W, 3] what the rays see by daylight and lamps."""
    origin, rays, t, what = met
    near = torch.where(t.isfinite(), t, 0.0)
    normals = scene.field.normals(origin[0] + near * rays[0], origin[1] + near * rays[1])
    for index in np.unique(what.numpy()).tolist():
        if index >= 0:
            which = (what == index).nonzero()[:, 0]
            on = _pick(origin, which), rays[:, which], t[which]
            normals[:, which] = objects.normals(scene.shapes[index], *on)
    start = origin.mT.numpy() if origin.dim() > 1 else origin.numpy()
    seen = light.compose(J.reshape(-1, 3), start, rays.T.numpy(), t.numpy(), normals.T.numpy())
    return seen.reshape(J.shape)


def _pick(
    origin: torch.Tensor,  # [3] m, or [3, N] of each ray
    which: torch.Tensor,  # [M] rays
) -> torch.Tensor:
    """[3] or [3, M]"""
    return origin if origin.dim() == 1 else origin[:, which]


def _grain(
    scene: SyntheticScene,
    x: torch.Tensor,  # [N] m
    y: torch.Tensor,  # [N] m
    z: torch.Tensor,  # [N] m
    size: torch.Tensor,  # [N] m
) -> torch.Tensor:
    """Relative change [N] of the radiance on steep faces; ``size`` (m) is the ray's footprint."""
    texel = objects.TEXEL_M
    u, v = (0.8 * x + 0.6 * y) / texel, (z + 0.5 * (0.8 * y - 0.6 * x)) / texel
    grain, patches = scene.object_texture.mirror(u, v, size / texel)
    change: torch.Tensor = (0.32 * grain + 0.22 * patches).clamp(-0.75, 0.9)
    return change


def _footprint(
    x: torch.Tensor,  # [R, C] m
    y: torch.Tensor,  # [R, C] m
) -> torch.Tensor:
    """Size [R, C] (m) on the map of a ray's surroundings, from where its neighbours hit.

    The geometric mean of the two sides; the nearer of two neighbours counts, so that the edge of a
    stone does not blur what lies behind it.
    """
    sides = []
    for axis in (0, 1):
        step = torch.hypot(x.diff(dim=axis), y.diff(dim=axis))
        first, last = step.narrow(axis, 0, 1), step.narrow(axis, -1, 1)
        sides.append(torch.minimum(torch.cat([first, step], axis), torch.cat([step, last], axis)))
    longest = torch.maximum(sides[0], sides[1])
    return torch.maximum((sides[0] * sides[1]).sqrt(), 0.4 * longest)
