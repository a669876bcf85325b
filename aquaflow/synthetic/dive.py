"""Writing a synthetic dive: the pictures, and everything that is true about them."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt
import yaml
from scipy.spatial.transform import Rotation

from aquaflow.errors import InputError, reason_of
from aquaflow.geometry.camera import CameraModel
from aquaflow.storage.camera_file import save_camera
from aquaflow.synthetic import objects, pool, radiance, render
from aquaflow.synthetic import path as paths
from aquaflow.synthetic.config import SyntheticConfig
from aquaflow.synthetic.display import burn_in
from aquaflow.synthetic.march import HeightField
from aquaflow.synthetic.placement import place_objects
from aquaflow.synthetic.relief import Area
from aquaflow.synthetic.sensor import Snow, expose, quantised, vignette
from aquaflow.synthetic.telemetry import write_telemetry
from aquaflow.synthetic.terrain import build_relief
from aquaflow.synthetic.texture import MipAtlas
from aquaflow.synthetic.water import WATER_TYPES, save_medium
from aquaflow.synthetic.ways import way_of

__all__ = ["FORMAT_VERSION", "build", "camera_of", "write_dive"]

Array: TypeAlias = npt.NDArray[np.float64]

MARKER = "synth.yaml"
"""The file by which a folder is known to be a synthetic dive."""

FORMAT_VERSION = 1
"""Of the files and of the generator: the same config gives the same dive within a version."""

TEXEL_PX = 0.6
"""Size of a texel of the floor in pixels at the nearest usual range: sharp there and beyond."""
TEXELS_MOST = 14e6
"""Keeps the memory that a dive is made in at about 1.5 GB."""
MIP_LEVELS = 6
"""Of the floor's texture, each half as fine as the one before."""


def camera_of(config: SyntheticConfig) -> CameraModel:
    """The calibrated pinhole camera of a dive."""
    focal = config.focal_px
    return CameraModel(
        config.width, config.height, focal, focal, config.width / 2.0, config.height / 2.0
    )


def build(config: SyntheticConfig) -> tuple[render.SyntheticScene, paths.Path]:
    """The scene and the way through it."""
    # One stream each: the scene does not change when the path's or the sensor's draws do.
    terrain_rng, things_rng, colour_rng, sway_rng = _streams(config)[:4]
    loop = way_of(config).points
    flat = paths.plan_path(config, sway_rng)
    low, high = _seen(config, flat)
    texel = max(
        TEXEL_PX * (config.altitude_m - 0.2) / config.focal_px,
        math.sqrt(float(np.prod(high - low)) / TEXELS_MOST),
    )
    area = Area.around(low, high, texel * radiance.TEXELS_PER_CELL)
    relief = build_relief(config.scene, area, loop, terrain_rng)
    shapes = place_objects(config.scene, relief, loop, things_rng)
    floor = radiance.bake(config.scene, relief, objects.casters(relief, shapes), colour_rng)
    scene = render.SyntheticScene(
        area,
        HeightField(area, relief.height),
        MipAtlas(floor, MIP_LEVELS),
        shapes,
        objects.object_texture(colour_rng),
        config.max_range_m,
    )
    below = area.sample(relief.height, loop)
    return scene, paths.plan_path(config, _streams(config)[3], below)


def _streams(config: SyntheticConfig) -> list[np.random.Generator]:
    return [np.random.default_rng(s) for s in np.random.SeedSequence(config.seed).spawn(7)]


def _seen(config: SyntheticConfig, flat: paths.Path) -> tuple[Array, Array]:
    """Corners [2] (m, survey frame) of the floor that the dive sees."""
    if config.scene == "pool":
        return pool.corners(way_of(config).points)
    t = np.linspace(0.0, config.duration_s, 65)
    camera = camera_of(config)
    corners = np.array([[x, y] for x in (0, camera.width) for y in (0, camera.height)], float)
    rays = camera.unproject(corners)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    directions = np.einsum("nij,kj->nki", flat.R_ws.T @ flat.R_wc(t), rays)
    centre = flat.centre_s(t)[:, None, :]
    # Relief makes rays travel further than over a flat floor; a metre more than the camera's
    # height covers hollows.
    drop = np.maximum(directions[..., 2], 1e-3)
    reach = np.minimum((1.0 - centre[..., 2]) / drop, config.max_range_m)
    points = (centre + reach[..., None] * directions)[..., :2].reshape(-1, 2)
    points = np.vstack([points, centre[:, 0, :2]])
    return points.min(axis=0) - 0.5, points.max(axis=0) + 0.5


def write_dive(
    out: Path, config: SyntheticConfig, progress: Callable[[int, int], None] | None = None
) -> None:
    """Write a dive with its ground truth (files: see :mod:`aquaflow.synthetic.truth`).

    Args:
        out: folder, made if needed; a dive that is there is replaced.
        config: what to make.
        progress: called with (pictures written, pictures in all).

    Raises:
        InputError: ``out`` cannot be written to, or holds files that are not a synthetic dive.
    """
    if out.is_dir() and not (out / MARKER).is_file() and any(p.is_file() for p in out.rglob("*")):
        raise InputError(f"{out} holds files that are not a synthetic dive; choose another folder")
    try:
        for name in ("images", "range", "clean"):
            folder = out / name
            folder.mkdir(parents=True, exist_ok=True)
            for old in folder.iterdir():
                old.unlink()
        scene, path = build(config)
        _write_tables(out, config, path)
        _write_pictures(out, config, scene, path, progress)
    except OSError as error:
        raise InputError(
            f"cannot write the dive to {out}: {reason_of(error)}; choose another folder"
        ) from error


def _write_tables(out: Path, config: SyntheticConfig, path: paths.Path) -> None:
    t = np.arange(config.frames) / config.fps
    save_camera(camera_of(config), out / "camera.yaml")
    save_medium(WATER_TYPES[config.water], out / "medium.yaml")
    (out / "timestamps.txt").write_text("".join(f"{value:.9f}\n" for value in t))
    xyzw = Rotation.from_matrix(path.R_wc(t)).as_quat(canonical=True)
    rows = np.column_stack([path.centre_w(t), xyzw]).tolist()
    lines = [f"{t[k]:.9f} " + " ".join(map(repr, row)) + "\n" for k, row in enumerate(rows)]
    (out / "poses.tum").write_text("".join(lines))
    write_telemetry(out / "telemetry.csv", config, path, _streams(config)[4])
    stated = {
        "version": FORMAT_VERSION,
        "config": config.model_dump(exclude_none=True),
        "frames": {
            "world": "z down, metres, z = 0 at the surface (NED-like)",
            "camera": "x right, y down, z forward; poses are camera to world",
            "body": "forward, right, down; its origin is the camera's centre",
        },
        "mounting": {"R_body_camera": path.R_bc.tolist(), "t_body_camera_m": [0.0, 0.0, 0.0]},
        "vignette": "image = water * (1 - vignette * r^2 / r_corner^2), before noise",
        "loop_length_m": config.speed_m_s * config.duration_s,
    }
    (out / MARKER).write_text(yaml.safe_dump(stated, sort_keys=False))


def _write_pictures(
    out: Path,
    config: SyntheticConfig,
    scene: render.SyntheticScene,
    path: paths.Path,
    progress: Callable[[int, int], None] | None,
) -> None:
    t = np.arange(config.frames) / config.fps
    R_sc, centres = path.R_ws.T @ path.R_wc(t), path.centre_s(t)
    camera, medium = camera_of(config), WATER_TYPES[config.water]
    snow_rng, noise_rng = _streams(config)[5:]
    snow = Snow(config, centres, snow_rng)
    shade = vignette(camera, config.vignette)
    with ThreadPoolExecutor(1) as pool:
        # Compressing a picture overlaps with rendering the next; one is waited for at a time.
        pending: Future[None] | None = None
        for k in range(config.frames):
            view = render.render(scene, camera, R_sc[k], centres[k], medium, config.supersampling)
            water = view.water.copy()
            snow.draw(water, view.range_m, camera, R_sc[k], centres[k], float(t[k]), medium)
            picture = expose(water, shade, config.noise_sigma, noise_rng)
            if config.display is not None:
                burn_in(picture, config.display, float(t[k]))
            if pending is not None:
                pending.result()
            pending = pool.submit(_save, out, k, picture, replace(view, water=water))
            if progress is not None:
                progress(k + 1, config.frames)
        if pending is not None:
            pending.result()


def _save(
    out: Path,
    index: int,
    picture: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    view: render.RenderedView,
) -> None:
    name = f"{index:06d}"
    _save_png(out / "images" / f"{name}.png", picture)
    _save_png(out / "clean" / f"{name}.png", quantised(view.clean))
    hit = np.isfinite(view.range_m)
    stored = np.where(hit, view.range_m, 0.0).astype(np.float32)
    np.savez(out / "range" / f"{name}.npz", range_m=stored, hit=hit)


def _save_png(
    path: Path,
    rgb: npt.NDArray[np.uint8],  # [H, W, 3] RGB
) -> None:
    if not cv2.imwrite(str(path), rgb[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 2]):
        raise OSError(f"{path} was not written")
