"""``aquaflow lab evaluate``: one dive against its ground truth.

Only the largest sub-map is compared: sub-maps share no frame of reference, and aligning each on its
own would hide the break between them. How many poses that leaves out is part of the result.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.medium import NAME as MEDIUM
from aquaflow.geometry.arrays import sim3_to_json
from aquaflow.lab.evaluation import metric_error as water
from aquaflow.lab.evaluation.dive_files import EvaluatedDive, evaluated_dive
from aquaflow.lab.evaluation.metric_error import MetricError, metric_error
from aquaflow.lab.evaluation.trajectory_error import (
    ASSOCIATION_TOLERANCE_S,
    Trajectory,
    TrajectoryError,
    associate,
    horizontal_error,
    position_error,
    trajectory_error,
)
from aquaflow.lab.evaluation.truth import PositionTable, read_truth
from aquaflow.lab.synthetic.water import load_medium

COPIED_METRICS = (
    "psnr", "ssim", "psnr_as_tracked", "ssim_as_tracked", "flip", "lpips", "lpips_alex",
    "lpips_reason",
)  # fmt: skip
"""Measured while mapping, on the held-out frames; the evaluation repeats them."""


@dataclass(frozen=True)
class Evaluation:
    """The errors of one dive."""

    dive: EvaluatedDive
    error: TrajectoryError
    medium: water.MediumError | None
    metric: MetricError | None
    """None for a dive in map units."""
    metrics: dict[str, Any]
    notes: list[str] = field(default_factory=list)
    """Sentences for the reader on what was compared and how."""

    def to_json(self) -> dict[str, Any]:
        """Stable keys. Distances are in the truth's unit, metres if the truth is metric."""
        error, sim3 = self.error, self.error.sim3.alignment.T_target_source
        relative = error.relative
        return {
            "frames": self.dive.frames,
            "posed": self.dive.posed,
            "posed_fraction": self.dive.posed / self.dive.frames,
            "sub_map": self.dive.sub_map,
            "sub_maps": self.dive.sub_maps,
            "left_out": self.dive.left_out,
            "matched": error.matched,
            "ate_rmse_m_se3": error.se3.rmse,
            "ate_rmse_m_sim3": error.sim3.rmse,
            "ate_pct_se3": error.se3.pct,
            "ate_pct_sim3": error.sim3.pct,
            "rotation_rmse_deg": error.rotation_rmse_deg,
            "rpe": relative.to_json() if relative else None,
            "rpe_translation_pct": relative.translation_pct if relative else None,
            "drift_pct": error.drift_pct,
            "path_length": error.path_length,
            "alignment": {
                "kind": "sim3",
                **sim3_to_json(sim3),
                "collinear": error.sim3.alignment.collinear,
            },
            "metric": self.metric.to_json() if self.metric else None,
            "medium_error": self.medium.to_json() if self.medium else None,
            **{key: self.metrics.get(key) for key in COPIED_METRICS},
            "notes": self.notes,
        }


def evaluate_dive(dive: Path, truth: Path) -> Evaluation:
    """Compare the dive's largest sub-map with ``truth``.

    Args:
        dive: the folder that a run wrote.
        truth: a TUM file, a CSV of picture positions, or a synthetic dive's folder.

    Raises:
        InputError: a file is missing or malformed, or too few poses have a truth.
    """
    read = Dive(dive)
    estimate = evaluated_dive(read)
    known = read_truth(truth)
    notes = _notes_on(estimate)
    estimated, true = estimate.trajectory, None
    if known.trajectory is not None:
        estimated, true, path = _pair(estimate.trajectory, known.trajectory, truth)
        error = trajectory_error(estimated, true, path)
    else:
        assert known.positions is not None
        error, said = _with_positions(estimate, known.positions, truth)
        notes += said
    frame = read.frame_of(estimate.sub_map)
    scale = error.sim3.alignment.T_target_source.scale
    level = (estimated, true) if known.z_down and true is not None else None
    metric = metric_error(frame, scale, error.se3.rmse, level)
    if metric is not None and true is not None and not known.z_down:
        notes.append(f"{truth} is taken to be in metres, as the dive is")
    if error.sim3.alignment.collinear:
        notes.append(
            "the path is a straight line, so the turn about it is unknown and absolute rotations "
            "are not compared"
        )
    compared = None
    if known.medium is not None and read.has(MEDIUM):
        found, active = water.recovered_water(read, scale)
        compared = water.compare_medium(found, load_medium(known.medium), active=active)
    return Evaluation(estimate, error, compared, metric, read.metrics, notes)


def _notes_on(dive: EvaluatedDive) -> list[str]:
    if not dive.left_out:
        return []
    return [
        f"only the largest of {dive.sub_maps} sub-maps is compared; {dive.left_out} of "
        f"{dive.posed} poses lie in the others"
    ]


def _pair(
    estimate: Trajectory, truth: Trajectory, source: Path
) -> tuple[Trajectory, Trajectory, float]:
    """The poses of the same moments, and the length of the true path."""
    ours, theirs = associate(estimate.t_s, truth.t_s, ASSOCIATION_TOLERANCE_S)
    if len(ours) == 0:
        raise InputError(
            f"no pose of {source} is within {ASSOCIATION_TOLERANCE_S:g} s of a pose of the dive: "
            f"the truth covers {truth.t_s[0]:g} to {truth.t_s[-1]:g} s, the dive "
            f"{estimate.t_s[0]:g} to {estimate.t_s[-1]:g} s; check the frame rate and the "
            "first frame's time"
        )
    # The path between the first and the last common pose, with the truth's poses in between:
    # leaving them out would cut corners.
    path = truth.select(np.arange(theirs[0], theirs[-1] + 1)).path_length
    return estimate.select(ours), truth.select(theirs), path


def _with_positions(
    dive: EvaluatedDive, truth: PositionTable, source: Path
) -> tuple[TrajectoryError, list[str]]:
    """Errors over the pictures of the same name, with what the reader must know."""
    row_of = {name: row for row, name in enumerate(truth.files)}
    names = [Path(name).name for name in dive.sources]
    ours = [i for i, name in enumerate(names) if name in row_of]
    if not ours:
        raise InputError(
            f"no picture named in {source} has a pose in the dive; the names in its column 'file' "
            "must be those of the pictures that were mapped"
        )
    positions = truth.positions[[row_of[names[i]] for i in ours]]
    path = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    posed = dive.trajectory.select(np.array(ours))
    error = position_error(posed.positions, positions, path)
    level = horizontal_error(posed, positions[:, :2])
    return error, [
        "the truth has horizontal positions only: camera positions are aligned in 3D with a true "
        "height of zero, so height differences count as error; in the horizontal alone, the mean "
        f"viewing direction taken as the vertical, it is {level:.3g} m, "
        f"{100.0 * level / path:.2g} % of the path"
    ]
