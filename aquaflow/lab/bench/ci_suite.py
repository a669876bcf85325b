"""Suite ``ci``: synthetic dives of several kinds, small enough for every change to be judged."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import yaml

from aquaflow.base.errors import InputError
from aquaflow.lab.bench.scene import BenchmarkScene
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import FORMAT_VERSION, write_dive

SMALL = {
    "frames": 24, "width": 160, "height": 120, "supersampling": 1, "camera_pitch_deg": 55.0,
}  # fmt: skip
"""A floor seen steeply is a small floor: most of the time to make a dive goes there."""

PLAIN: dict[str, dict[str, object]] = {
    "reef, loop": {"scene": "reef"},
    "flat sand, fast": {"scene": "flat_sand", "speed_m_s": 0.9},
    "wall, murky, slow": {"scene": "wall", "water": "coastal_5C", "speed_m_s": 0.5},
    "pool, tiles, display": {
        "scene": "pool",
        "camera_pitch_deg": 10.0,
        "display": "clock_and_crosshair",
    },
    "hull, equal plates": {"scene": "hull"},
    "net, open water": {"scene": "net"},
}
PIPE: dict[str, object] = {"scene": "pipe", "water": "oceanic_IB"}
"""The plain scenes by name, and the pipe that a pause is made in: what differs from SMALL."""
PAUSED, DIMMED = "pipe, clear, pause", "reef, light change"
DIMMED_FROM = "reef, loop"
"""Scenes that are made of others: the pipe with a pause, a reef whose light changes."""
PAUSE_AT, PAUSE_FRAMES = 12, 5
DIM_AT, DIM_GAIN = 12, 0.65
"""Picture at which it happens, half-way through; how many the pause adds, and what light is
left."""

REFINE_SHARE = 0.1
"""Of a preset's refining steps; the pictures have a ninth of the default's pixels."""
BRIEF: dict[str, object] = {"mapping": {"medium": {"fit_views": 8}}}
"""The water's fit takes half of a small run's time, and its observations come from every view."""

STAMP = "bench_scene.json"
"""Says what a cached scene was made from."""

Progress = Callable[[str, int, int | None], None]


def ci_scenes(cache: Path, progress: Progress) -> list[BenchmarkScene]:
    """The suite's scenes, written to ``cache`` where they are not there yet."""
    total, scenes = len(PLAIN) + 2, []
    for done, (name, kind) in enumerate(PLAIN.items()):
        progress("scenes", done, total)
        scenes.append(_cache(cache, name, {**SMALL, **kind}, _write))
    piped = {**SMALL, **PIPE}
    pipe = Path(_cache(cache, "pipe", piped, _write).recording)
    reef = next(Path(scene.recording) for scene in scenes if scene.name == DIMMED_FROM)

    def write_paused(out: Path, _: dict[str, object]) -> None:
        pause(pipe, out, PAUSE_AT, PAUSE_FRAMES)

    def write_dimmed(out: Path, _: dict[str, object]) -> None:
        dim_light(reef, out, DIM_AT, DIM_GAIN)

    stopped = {**piped, "pause": [PAUSE_AT, PAUSE_FRAMES]}
    darker = {**SMALL, **PLAIN[DIMMED_FROM], "dim": [DIM_AT, DIM_GAIN]}
    scenes.append(_cache(cache, PAUSED, stopped, write_paused))
    scenes.append(_cache(cache, DIMMED, darker, write_dimmed))
    progress("scenes", total, total)
    return scenes


def _write(out: Path, settings: dict[str, object]) -> None:
    write_dive(out, SyntheticConfig.model_validate(settings))


def _cache(
    cache: Path,
    name: str,
    settings: dict[str, object],
    make: Callable[[Path, dict[str, object]], None],
) -> BenchmarkScene:
    folder = cache / name.replace(", ", "_").replace(" ", "_")
    stamp = json.dumps({"format": FORMAT_VERSION, **settings}, sort_keys=True)
    marker = folder / STAMP
    if not marker.is_file() or marker.read_text() != stamp:
        marker.unlink(missing_ok=True)
        make(folder, settings)
        marker.write_text(stamp)
    path = str(folder)
    return BenchmarkScene(
        name, path, truth=path, clean=path, overrides=BRIEF, refine_share=REFINE_SHARE
    )


# --------------------------------------------------------------------------------------------------
# Dives made from another synthetic dive: the vehicle pauses, or the light changes.
#
# Pictures change; poses, ranges, water and the scene without water stay true.

NOISE_SIGMA = 0.005
"""Of full scale: a camera that stands still does not see the same noise twice."""

KEPT = ("camera.yaml", "medium.yaml", "synth.yaml")
"""Files that do not change with the pictures."""


def pause(dive: Path, out: Path, at: int, frames: int) -> None:
    """Write ``dive`` as if the vehicle had stood still for ``frames`` pictures after ``at``.

    Raises:
        InputError: the dive has no picture ``at``.
    """
    times, poses = _tables(dive)
    if not 0 <= at < len(times):
        raise InputError(f"{dive} has {len(times)} pictures; it cannot pause at {at}")
    order = [*range(at + 1), *[at] * frames, *range(at + 1, len(times))]
    step = float(np.median(np.diff(times)))
    shifted = [times[0] + step * k for k in range(len(order))]
    _begin(dive, out)
    _write_tables(out, shifted, [poses[k] for k in order])
    random = np.random.default_rng(0)
    for new, old in enumerate(order):
        picture = _read(dive, old)
        if new > at and old == at:
            noise = random.normal(0.0, 255.0 * NOISE_SIGMA, picture.shape)
            picture = np.clip(np.round(picture + noise), 0, 255).astype(np.uint8)
        _write_picture(dive, out, old, new, picture)


def dim_light(dive: Path, out: Path, at: int, gain: float) -> None:
    """Write ``dive`` with pictures from ``at`` on ``gain`` times as bright, as lamps going down."""
    times, poses = _tables(dive)
    _begin(dive, out)
    _write_tables(out, times, poses)
    for k in range(len(times)):
        picture = _read(dive, k)
        if k >= at:
            picture = np.clip(np.round(picture * gain), 0, 255).astype(np.uint8)
        _write_picture(dive, out, k, k, picture)


def _tables(dive: Path) -> tuple[list[float], list[str]]:
    """Times (s), and the poses as TUM text without their times."""
    lines = (dive / "poses.tum").read_text(encoding="utf-8").split("\n")
    rows = [line.split(" ", 1) for line in lines if line and not line.startswith("#")]
    return [float(row[0]) for row in rows], [row[1] for row in rows]


def _begin(dive: Path, out: Path) -> None:
    if out.exists():
        shutil.rmtree(out)
    for name in ("images", "clean", "range"):
        (out / name).mkdir(parents=True)
    for name in KEPT:
        shutil.copyfile(dive / name, out / name)
    stated = yaml.safe_load((out / "synth.yaml").read_text(encoding="utf-8"))
    stated["altered_from"] = dive.name
    (out / "synth.yaml").write_text(yaml.safe_dump(stated, sort_keys=False), encoding="utf-8")


def _write_tables(out: Path, times: list[float], poses: list[str]) -> None:
    (out / "timestamps.txt").write_text("".join(f"{t:.9f}\n" for t in times), encoding="utf-8")
    rows = [f"{t:.9f} {pose}\n" for t, pose in zip(times, poses, strict=True)]
    (out / "poses.tum").write_text("".join(rows), encoding="utf-8")


def _read(dive: Path, index: int) -> npt.NDArray[np.uint8]:
    bgr = cv2.imread(str(dive / "images" / f"{index:06d}.png"), cv2.IMREAD_COLOR)
    if bgr is None:
        raise InputError(f"cannot read picture {index} of {dive}; make the dive again")
    return np.asarray(bgr, dtype=np.uint8)


def _write_picture(
    dive: Path,
    out: Path,
    old: int,
    new: int,
    picture: npt.NDArray[np.uint8],  # [H, W, 3] BGR
) -> None:
    cv2.imwrite(str(out / "images" / f"{new:06d}.png"), picture)
    for folder, suffix in (("clean", "png"), ("range", "npz")):
        shutil.copyfile(dive / folder / f"{old:06d}.{suffix}", out / folder / f"{new:06d}.{suffix}")
