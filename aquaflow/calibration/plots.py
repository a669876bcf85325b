"""The residuals of a calibration as one picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError, reason_of
from aquaflow.calibration.fit import Fit
from aquaflow.calibration.views import Views

ARROW_SHARE = 0.04
"""Length of the 95th percentile's arrow, over the picture's width."""


def draw_residuals(views: Views, fit: Fit, path: Path) -> None:
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
