"""From pictures of a board to ``camera.yaml`` with its figures and plots."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import ConfigError, InputError, reason_of
from aquaflow.base.storage.atomic import write_json
from aquaflow.calibration.board import Board, Detector, Views, find_views
from aquaflow.calibration.fit import CalibrationFit, fit_lens, fit_port
from aquaflow.geometry.camera import CameraModel, DistortionModel, save_camera, save_for_others
from aquaflow.geometry.port import FlatPort
from aquaflow.sources import open_recording
from aquaflow.types import Frame

LEAST_CERTAIN = 5e-3
"""Relative sigma of the focal length up to which a calibration is worth having: at one percent,
the dive itself tells the focal length better."""


@dataclass(frozen=True)
class Calibration:
    """The result, and the pictures that it is from."""

    views: Views
    fit: CalibrationFit

    def to_json(self) -> dict[str, Any]:
        """Figures for calibration.json."""
        pictures = {
            view.name: round(float(np.sqrt(np.mean(left[keep] ** 2))), 4)
            for view, left, keep in zip(
                self.views.used, self.fit.residuals, self.fit.kept, strict=True
            )
            if keep.any()
        }
        return {
            "values": dict(zip(self.fit.names, self.fit.values.tolist(), strict=True)),
            "sigma": dict(zip(self.fit.names, self.fit.sigma.tolist(), strict=True)),
            "rms_px": round(self.fit.rms_px, 4),
            "coverage": round(self.views.coverage, 3),
            "pictures": self.views.read,
            "used": len(self.views.used),
            "without_board": self.views.without_board,
            "alike": len(self.views.alike),
            "corners": int(sum(keep.sum() for keep in self.fit.kept)),
            "corners_left_out": int(sum((~keep).sum() for keep in self.fit.kept)),
            "rms_px_of_pictures": pictures,
        }


def calibrate(
    source: Path,
    board: Board,
    model: DistortionModel,
    known: CameraModel | None = None,
    estimate_port: bool = False,
) -> Calibration:
    """Calibrate from a folder of pictures or a video of the board.

    Args:
        source: pictures of the board, in air, or in water through what is between.
        board: what they show.
        model: distortion of the lens, ``radtan`` or ``fisheye``.
        known: a camera whose port is kept while the lens is found; without it there is no port.
        estimate_port: keep the lens of ``known`` instead, and find its flat port's distance and
            normal.

    Raises:
        InputError: the pictures cannot be read, are too few, too much alike, or leave the result
            open.
        ConfigError: there is no such board, or ``known`` has no flat port to estimate.
    """
    views = find_views(_pictures(source), Detector(board))
    if estimate_port:
        if known is None or not isinstance(known.port, FlatPort):
            raise ConfigError(
                "estimating a port needs a known camera with the lens in air and a "
                "first guess of its flat port; give --known camera.yaml"
            )
        return _certain(Calibration(views, fit_port(views.used, _scale_to_images(known, views))))
    size = (views.width, views.height)
    start = CameraModel(*size, 1.0, 1.0, views.width / 2.0, views.height / 2.0, model)
    if known is not None:
        start = CameraModel(**{**vars(start), "port": known.port})
    return _certain(Calibration(views, fit_lens(views.used, start)))


def _certain(found: Calibration) -> Calibration:
    """Raises InputError where the focal length is left open."""
    focal, sigma = found.fit.camera.fx, dict(zip(found.fit.names, found.fit.sigma, strict=True))
    if sigma.get("fx", 0.0) > LEAST_CERTAIN * focal:
        raise InputError(
            f"these pictures leave the focal length open, {focal:.0f} +- {sigma['fx']:.0f} px; "
            "tilt the board by 30 degrees to all sides and bring it close, so that it fills half "
            "of the picture"
        )
    return found


def _scale_to_images(known: CameraModel, views: Views) -> CameraModel:
    if abs(known.width * views.height / (known.height * views.width) - 1.0) > 0.01:
        raise InputError(
            f"the known camera has pictures of {known.width} x {known.height}, these are "
            f"{views.width} x {views.height}; give pictures of the same shape"
        )
    return known.resize(views.width, views.height)


def _pictures(source: Path) -> Iterator[tuple[str, npt.NDArray[np.uint8]]]:
    recording = open_recording(source)
    try:
        for frame in recording.frames():
            if isinstance(frame, Frame):
                yield recording.name_of(frame.index), frame.image
    finally:
        recording.close()


def write_calibration(found: Calibration, out: Path) -> list[Path]:
    """Write ``camera.yaml``, ``calibration.json``, ``residuals.png``, and the camera for ROS and
    for OpenCV; the files, in that order.

    Raises:
        InputError: the folder cannot be written to.
    """
    files = [out / name for name in ("camera.yaml", "calibration.json", "residuals.png")]
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {out}; choose another --out") from error
    save_camera(found.fit.camera, files[0])
    write_json(files[1], found.to_json())
    draw_residuals(found.views, found.fit, files[2])
    return files + save_for_others(found.fit.camera, out)


# --------------------------------------------------------------------------------------------------
# The residuals of a calibration as one picture.

ARROW_SHARE = 0.04
"""Length of the 95th percentile's arrow, over the picture's width."""


def draw_residuals(views: Views, fit: CalibrationFit, path: Path) -> None:
    """Residual vectors over the picture, their histogram, and the error of every picture.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    kept = np.concatenate(fit.kept)
    at = np.concatenate([view.found.pixels for view in views.used])[kept]
    left = np.concatenate(fit.residuals)[kept]
    figure = Figure(figsize=(11, 7), layout="constrained")
    FigureCanvasAgg(figure)
    over, parts = figure.subplots(1, 2, width_ratios=[2, 1]), None
    grid = over[1].get_subplotspec()
    assert grid is not None
    over[1].remove()
    parts = grid.subgridspec(2, 1)
    longest = float(np.percentile(np.linalg.norm(left, axis=1), 95.0))
    grow = ARROW_SHARE * views.width / max(longest, 1e-9)
    over[0].quiver(
        at[:, 0], at[:, 1], *(grow * left.T), angles="xy", scale_units="xy", scale=1, width=0.0015
    )
    over[0].set(
        xlim=(0, views.width), ylim=(views.height, 0), aspect="equal", xlabel="px", ylabel="px",
        title=f"residuals, {grow:.0f} times enlarged; {views.coverage:.0%} of the picture covered",
    )  # fmt: skip
    histogram = figure.add_subplot(parts[0])
    histogram.hist(left, bins=40, histtype="step", label=["x", "y"])
    histogram.legend()
    histogram.set(xlabel="seen - expected, px", title=f"{len(left)} corners, {fit.rms_px:.3f} px")
    pictures = figure.add_subplot(parts[1])
    errors = [
        float(np.sqrt(np.mean(each[keep] ** 2))) if keep.any() else 0.0
        for each, keep in zip(fit.residuals, fit.kept, strict=True)
    ]
    pictures.bar(np.arange(len(errors)), errors)
    pictures.set(xlabel="picture", ylabel="RMS, px")
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise InputError(f"cannot write {path}: {reason_of(error)}") from error
