"""Errors of metres, gravity and north: exact on trajectories with a known error."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.dive.tum import write_tum
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.evaluation.metric_error import MetricError, level_error, metric_error
from aquaflow.lab.evaluation.protocol import evaluate_dive
from aquaflow.lab.evaluation.summary import in_words
from aquaflow.lab.evaluation.trajectory_error import Trajectory
from aquaflow.telemetry.metric_file import write_metric_file
from aquaflow.telemetry.world_frame import WorldFrame
from tests.metric_scenes import SIGMAS, metric_frame

COUNT = 40
RNG = np.random.default_rng(0)
TRUTH = Trajectory(
    np.arange(COUNT) / 10.0,
    RNG.normal(size=(COUNT, 3)).cumsum(0),
    Rotation.random(COUNT, random_state=0).as_quat(scalar_first=True),
)
TILT, YAW, STRETCH = np.radians(0.5), np.radians(-3.0), 1.02


def wrong(tilt: float = TILT, yaw: float = YAW, scale: float = STRETCH) -> Trajectory:
    """The truth turned about its vertical, then tilted about north, and stretched."""
    turn = Rotation.from_euler("x", tilt) * Rotation.from_euler("z", yaw)
    return TRUTH.transform(Sim3(turn.as_matrix(), np.array([3.0, -2.0, 1.0]), scale))


def found(frame: WorldFrame, estimate: Trajectory) -> MetricError:
    error = metric_error(frame, 1.0 / STRETCH, 0.1, (estimate, TRUTH))
    assert error is not None
    return error


def test_errors_are_those_that_were_made() -> None:
    error = found(metric_frame(), wrong())
    assert error.scale_error_pct == pytest.approx(2.0)
    assert error.gravity_error_deg == pytest.approx(0.5, abs=1e-6)
    assert error.heading_error_deg == pytest.approx(-3.0, abs=1e-3)
    assert error.scale_error_sigmas == pytest.approx(np.log(1.02) / SIGMAS[6])
    assert error.gravity_error_sigmas == pytest.approx(TILT / SIGMAS[3])
    assert error.heading_error_sigmas == pytest.approx(YAW / SIGMAS[5], rel=1e-3)


def test_a_straight_path_has_its_gravity_error_from_the_rotations() -> None:
    line = TRUTH.positions * [1.0, 0.0, 0.0]
    estimate = wrong(scale=1.0)
    straight = Trajectory(TRUTH.t_s, line, estimate.wxyz)
    error = metric_error(
        metric_frame(), 1.0, 0.0, (straight, Trajectory(TRUTH.t_s, line, TRUTH.wxyz))
    )
    assert error is not None
    assert error.gravity_error_deg == pytest.approx(0.5, abs=1e-6)


def test_the_level_error_forgives_yaw_and_translation_and_nothing_else() -> None:
    assert level_error(wrong(0.0, 1.0, 1.0).positions, TRUTH.positions) < 1e-9
    x = TRUTH.positions - TRUTH.positions.mean(axis=0)
    tilted = Rotation.from_euler("x", 0.2).apply(x)
    turned = [Rotation.from_euler("z", yaw).apply(tilted) - x for yaw in np.linspace(-1, 1, 2001)]
    best = min(np.sqrt((missed**2).sum(axis=1).mean()) for missed in turned)
    assert level_error(tilted, x) == pytest.approx(best, rel=1e-4)
    assert best > 0.1
    stretched = level_error(wrong(0.0, 0.0, STRETCH).positions, TRUTH.positions)
    assert stretched == pytest.approx(0.02 * np.sqrt((x**2).sum(axis=1).mean()))


def test_what_the_dive_does_not_state_has_no_error() -> None:
    assert metric_error(WorldFrame.unknown(), 1.0, 0.1, (wrong(), TRUTH)) is None
    not_level = found(metric_frame(level=False), wrong())
    assert not_level.gravity_error_deg is not_level.ate_rmse_m_level is None
    assert not_level.scale_error_pct == pytest.approx(2.0)
    no_north = found(metric_frame(north="initial heading"), wrong())
    assert no_north.heading_error_deg is no_north.heading_error_sigmas is None
    assert no_north.gravity_error_deg is not None
    sure = found(metric_frame(covariance=np.zeros((7, 7))), wrong())
    assert sure.scale_error_sigmas is None


def dive_and_truth(root: Path, synthetic: bool) -> tuple[Path, Path]:
    """A metric dive with the wrong trajectory, and the folder of its truth."""
    dive, truth = root / "dive", root / "truth"
    for folder, poses, name in ((dive, wrong(), "trajectory.tum"), (truth, TRUTH, "poses.tum")):
        folder.mkdir()
        write_tum(folder / name, poses.t_s, poses.positions, poses.wxyz)
    rows = [f"{i},{i}.png,{t:.6f},common,0" for i, t in enumerate(TRUTH.t_s)]
    (dive / "frames.csv").write_text("\n".join(["index,source,t_s,class,sub_map", *rows]) + "\n")
    write_metric_file(dive, {0: metric_frame()}, main=0)
    if synthetic:
        (truth / "synth.yaml").touch()
    return dive, truth


def test_the_evaluation_of_a_synthetic_dive_says_each_error_and_its_sigma(tmp_path: Path) -> None:
    result = evaluate_dive(*dive_and_truth(tmp_path, synthetic=True)).to_json()
    metric = result["metric"]
    assert metric["scale_error_pct"] == pytest.approx(2.0, abs=1e-3)
    assert metric["gravity_error_deg"] == pytest.approx(0.5, abs=1e-4)
    assert metric["ate_rmse_m"] == result["ate_rmse_m_se3"] > 0.0
    assert metric["ate_rmse_m_level"] > metric["ate_rmse_m"]
    assert result["notes"] == []
    said = "\n".join(in_words(result))
    for text in (
        "scale error                     2 %, 5 times its stated sigma of 0.4",
        "gravity error                   0.5 degrees, 2.9 times its stated sigma of 0.172",
        "heading error                   -3 degrees, 5.2 times its stated sigma of 0.573",
        "only turned about the vertical and shifted",
    ):
        assert text in said, said
    json.dumps(result, allow_nan=False)


def test_a_truth_of_unknown_axes_has_no_gravity_and_is_taken_to_be_metric(tmp_path: Path) -> None:
    result = evaluate_dive(*dive_and_truth(tmp_path, synthetic=False)).to_json()
    assert result["metric"]["gravity_error_deg"] is None
    assert result["metric"]["scale_error_pct"] == pytest.approx(2.0, abs=1e-3)
    assert "is taken to be in metres" in result["notes"][0]


def test_a_dive_in_map_units_has_no_metric_errors(tmp_path: Path) -> None:
    dive, truth = dive_and_truth(tmp_path, synthetic=True)
    (dive / "metric.json").unlink()
    result = evaluate_dive(dive, truth).to_json()
    assert result["metric"] is None
    assert not any("scale error" in line for line in in_words(result))
