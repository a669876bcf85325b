"""Writing a synthetic dive: the pictures, and everything that is true about them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt
import yaml
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import InputError, reason_of
from aquaflow.config.stage import MountingConfig
from aquaflow.geometry.camera import save_camera
from aquaflow.lab.synthetic import objects, radiance, render
from aquaflow.lab.synthetic import path as paths
from aquaflow.lab.synthetic.bodies import Bodies
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.display import burn_in
from aquaflow.lab.synthetic.march import RayHeightField
from aquaflow.lab.synthetic.motion import TrueBodyMotion
from aquaflow.lab.synthetic.planted import bleach
from aquaflow.lab.synthetic.range_effects import with_range_effects
from aquaflow.lab.synthetic.sensor import Snow, expose, quantise, vignette
from aquaflow.lab.synthetic.site import SurveySite, camera_of, site_of
from aquaflow.lab.synthetic.streams import stream
from aquaflow.lab.synthetic.telemetry.measurement import measure, write_positions
from aquaflow.lab.synthetic.telemetry.series import Constants, draw_constants
from aquaflow.lab.synthetic.telemetry.sonar import Sonar
from aquaflow.lab.synthetic.texture import MipAtlas
from aquaflow.lab.synthetic.water import WATER_TYPES, save_medium
from aquaflow.recordings.sample_table import write_telemetry
from aquaflow.types import TelemetrySample

__all__ = ["FORMAT_VERSION", "build", "camera_of", "write_dive"]

MARKER = "synth.yaml"
"""The file by which a folder is known to be a synthetic dive."""

POSITIONS = "positions.csv"
"""Fixes in a table of their own: a dive is on the earth only where its user wants it."""

FORMAT_VERSION = 4
"""Of the files and of the generator: the same config gives the same dive within a version."""

MIP_LEVELS = 6
"""Of the floor's texture, each half as fine as the one before."""


def build(config: SyntheticConfig) -> tuple[render.SyntheticScene, paths.Path]:
    """The scene and the way through it."""
    site = site_of(config)
    return _scene(config, site), site.path


def _scene(config: SyntheticConfig, site: SurveySite) -> render.SyntheticScene:
    """The site with its colours."""
    home = config.home
    colours = stream(home.seed, "colours")
    floor = radiance.bake(home.scene, site.relief, site.crests, colours)
    bleach(floor, site.relief.area, config.bleached)
    return render.SyntheticScene(
        site.relief.area,
        RayHeightField(site.relief.area, site.relief.height),
        MipAtlas(floor, MIP_LEVELS),
        site.shapes,
        objects.object_texture(colours),
        config.max_range_m,
    )


def write_dive(
    out: Path, config: SyntheticConfig, progress: Callable[[int, int], None] | None = None
) -> None:
    """Write a dive with its ground truth (files: see :mod:`aquaflow.lab.synthetic.truth`).

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
        site = site_of(config)
        _write_tables(out, config, site)
        _write_pictures(out, config, _scene(config, site), site.path, progress)
    except OSError as error:
        raise InputError(
            f"cannot write the dive to {out}: {reason_of(error)}; choose another folder"
        ) from error


def _write_tables(out: Path, config: SyntheticConfig, site: SurveySite) -> None:
    t, path = np.arange(config.frames) / config.fps, site.path
    save_camera(camera_of(config), out / "camera.yaml")
    water, lamps = WATER_TYPES[config.water], config.lamps
    save_medium(water if lamps is None else water.under(lamps.ambient), out / "medium.yaml")
    (out / "timestamps.txt").write_text("".join(f"{value:.9f}\n" for value in t))
    xyzw = Rotation.from_matrix(path.R_wc(t)).as_quat(canonical=True)
    rows = np.column_stack([path.centre_w(t), xyzw]).tolist()
    lines = [f"{t[k]:.9f} " + " ".join(map(repr, row)) + "\n" for k, row in enumerate(rows)]
    (out / "poses.tum").write_text("".join(lines))
    constants = draw_constants(config)
    sonar = Sonar(site.relief.area, site.crests)
    write_telemetry(out / "telemetry.csv", measure(config, site.motion, sonar, constants))
    write_positions(out / POSITIONS, config, site.motion)
    (out / MARKER).write_text(
        yaml.safe_dump(_truth_values(config, site, constants), sort_keys=False)
    )


def _truth_values(
    config: SyntheticConfig, site: SurveySite, constants: Constants
) -> dict[str, Any]:
    """What synth.yaml says."""
    mountings = site.motion.mountings
    place = mountings.p_bc.tolist()
    return {
        "version": FORMAT_VERSION,
        "config": config.model_dump(mode="json", exclude_none=True),
        "frames": {
            "world": "z down, metres, z = 0 at the surface (NED-like)",
            "camera": "x right, y down, z forward; poses are camera to world",
            "body": "forward, right, down; telemetry is that of its origin",
        },
        "mounting": {
            "R_body_camera": mountings.R_bc_stated.tolist(),
            "t_body_camera_m": place,
            "camera": mountings.stated.model_dump(mode="json"),
        },
        "truth": {
            "R_body_camera": mountings.R_bc.tolist(),
            "t_body_camera_m": place,
            "R_body_dvl": mountings.R_bd.tolist(),
            **constants.as_dict(),
        },
        "vignette": "image = water * (1 - vignette * r^2 / r_corner^2), before noise",
        "loop_length_m": config.speed_m_s * config.duration_s,
    }


def _write_pictures(
    out: Path,
    config: SyntheticConfig,
    scene: render.SyntheticScene,
    path: paths.Path,
    progress: Callable[[int, int], None] | None,
) -> None:
    t = np.arange(config.frames) / config.fps
    R_wc = path.R_wc(t)
    R_sc, centres = path.R_ws.T @ R_wc, path.centre_s(t)
    camera, mean = camera_of(config), WATER_TYPES[config.water]
    noise_rng = stream(config.seed, "sensor")
    snow = Snow(config, centres, stream(config.seed, "snow"))
    shade = vignette(camera, config.vignette)
    bodies = Bodies(config, t, R_sc, centres)
    light = np.array((1.0, 1.0, 1.0) if config.visit is None else config.visit.light, np.float32)
    with ThreadPoolExecutor(1) as pool:
        # Compressing a picture overlaps with rendering the next; one is waited for at a time.
        pending: Future[None] | None = None
        for k in range(config.frames):
            medium = mean.looking(R_wc[k, :, 2], config.directional_attenuation)
            view = render.render(
                scene,
                camera,
                R_sc[k],
                centres[k],
                medium,
                config.supersampling,
                bodies.at(k),
                config.lamps,
            )
            if config.range_effects is None:
                water = view.water.copy()
            else:
                water = with_range_effects(view, medium, camera.fx, config.range_effects)
            pose = R_sc[k], centres[k], float(t[k])
            snow.draw(water, view.range_m, camera, *pose, medium, config.lamps)
            picture = expose(water * light, shade, config.noise_sigma, noise_rng)
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
    _save_png(out / "clean" / f"{name}.png", quantise(view.clean))
    hit = np.isfinite(view.range_m)
    stored = np.where(hit, view.range_m, 0.0).astype(np.float32)
    masks = {"hit": hit, "moving": view.moving} if view.moving.any() else {"hit": hit}
    np.savez(out / "range" / f"{name}.npz", allow_pickle=False, range_m=stored, **masks)


def _save_png(
    path: Path,
    rgb: npt.NDArray[np.uint8],  # [H, W, 3] RGB
) -> None:
    if not cv2.imwrite(str(path), rgb[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 2]):
        raise OSError(f"{path} was not written")


# --------------------------------------------------------------------------------------------------
# A dive's motion and telemetry without its pictures.

Array: TypeAlias = npt.NDArray[np.float64]

CELL_M = 0.05
"""Of the relief: a tenth of an altimeter's footprint at 1.1 m."""


@dataclass(frozen=True)
class SimulatedDive:
    """What is true of a dive, and what its instruments say."""

    config: SyntheticConfig
    times_s: Array
    """[N] of the pictures; the first is 0."""
    T_wc: Array
    """[N, 4, 4] camera to world (z down, m, z = 0 at the surface; x is north), in truth."""
    T_bc: Array
    """[4, 4] camera to body (forward, right, down), m, in truth."""
    T_bc_stated: Array
    """[4, 4] the same as a user believes it: turned from the truth by ``mounting_error_deg``."""
    mounting: MountingConfig
    """``T_bc_stated`` as a vehicle's configuration has it."""
    R_bd: Array
    """[3, 3] axes of the DVL's samples to the body, in truth; the identity is stated."""
    constants: Constants
    """Errors of the instruments that were drawn once."""
    motion: TrueBodyMotion
    """The body's true pose, velocity, rate and specific force at any time of the dive."""
    samples: list[TelemetrySample]
    """In order of arrival; times are ns since the first picture. They are those of the body's
    origin and axes, as drivers hand them over."""


def simulate(config: SyntheticConfig) -> SimulatedDive:
    """Swim a dive without rendering it.

    The relief has cells of 5 cm at least. Where the pictures need finer ones, as usual, the dive
    that ``write_dive`` makes from the same config has another floor of the same kind, and follows
    that: same lanes, speeds, sway, mountings and constant errors, other heights.
    """
    site = site_of(config, CELL_M)
    motion, mountings = site.motion, site.motion.mountings
    constants = draw_constants(config)
    times_s = np.arange(config.frames) / config.fps
    return SimulatedDive(
        config,
        times_s,
        motion.T_wc(times_s),
        mountings.T_bc,
        mountings.T_bc_stated,
        mountings.stated,
        mountings.R_bd,
        constants,
        motion,
        measure(config, motion, Sonar(site.relief.area, site.crests), constants),
    )
