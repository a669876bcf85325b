"""Dives made from another synthetic dive: the vehicle pauses, or the light changes.

Pictures change; poses, ranges, water and the scene without water stay true.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import yaml

from aquaflow.base.errors import InputError

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
