"""Real surveys of eight stills: half of the positions are given as fixes, the others predicted."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from aquaflow import read_dive
from aquaflow.config import FusionConfig
from aquaflow.geometry.alignment import align
from aquaflow.geometry.earth import latitude_longitude, north_east
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.estimator import Estimate, estimate
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.types import Position
from tests.command_line import Cli

Array = npt.NDArray[np.float64]

SURVEYS = (3, *(pytest.param(each, marks=pytest.mark.slow) for each in (1, 6, 7)))
EVERY_S = 1.0
"""Between two stills; the files do not say."""
SIGMA_M = 0.1
ORIGIN = (-31.7, 115.0)
DRAWS = 10


@dataclass(frozen=True)
class Survey:
    """A tracked survey, and where its pictures were taken."""

    path: CameraPath
    truth: Array
    """[N, 3] m north, east and 0."""

    def predicted(self, given: Array, noise: Array) -> tuple[float, float, Estimate]:
        """Root mean square error (m) at the pictures without a fix: ours, and that of a similarity
        fitted to the same fixes."""
        fixes = self.truth + noise
        latitude, longitude = latitude_longitude(fixes, ORIGIN)
        telemetry = Telemetry()
        for i in np.flatnonzero(given):
            t_ns = round(self.path.t_s[i] * 1e9)
            telemetry.add(Position(t_ns, t_ns, "usbl", latitude[i], longitude[i], SIGMA_M))
        found = estimate(
            telemetry, self.path, FusionConfig(position_lag_sigma_s=0.0), None,
            lambda: np.zeros((0, 3)),
        )  # fmt: skip
        assert found.solution is not None
        assert found.problem is not None
        origin = found.problem.origin
        assert origin is not None
        _, p_n = found.solution.state.body(self.path.R_mc, self.path.p_m)
        place = np.array([origin.latitude_deg]), np.array([origin.longitude_deg])
        ours = p_n[:, :2] + north_east(*place, ORIGIN)
        T = align(self.path.p_m[given], fixes[given], with_scale=True).T_target_source
        theirs = T.apply(self.path.p_m)[:, :2]
        return self._error(ours, ~given), self._error(theirs, ~given), found

    def _error(self, places: Array, at: npt.NDArray[np.bool_]) -> float:
        off = (places - self.truth[:, :2])[at]
        return float(np.sqrt((off**2).sum(axis=1).mean()))


@pytest.fixture(scope="module", params=SURVEYS)
def survey(
    request: pytest.FixtureRequest,
    aquaflow: Cli,
    shared_data: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> Survey:
    folder = shared_data / f"auv_survey_{request.param}"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    dive = tmp_path_factory.mktemp("survey") / "dive"
    ran = aquaflow("map", folder, "--tracking-only", "--out", dive)
    assert ran.code == 0, ran.err
    rows = np.loadtxt(dive / "trajectory.tum")
    with (folder / "positions_geotiff.csv").open() as stream:
        known = [
            (float(r["northing_m"]), float(r["easting_m"]), 0.0) for r in csv.DictReader(stream)
        ]
    truth = np.array(known)
    assert len(rows) == len(truth)
    path = CameraPath(
        EVERY_S * np.arange(len(rows)), Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4]
    )
    return Survey(path, truth - truth.mean(axis=0))


def halves(survey: Survey) -> tuple[Array, Array]:
    even = np.arange(len(survey.path)) % 2 == 0
    return even, ~even


@pytest.mark.ci
def test_exact_fixes_of_one_half_predict_the_other_as_well_as_a_similarity(survey: Survey) -> None:
    ours, theirs = [], []
    for given in halves(survey):
        mine, similarity, found = survey.predicted(given, np.zeros_like(survey.truth))
        ours.append(mine)
        theirs.append(similarity)
        assert [(r.used, r.rejected) for r in found.frame.sources if r.kind == "position"] == [
            (int(given.sum()), 0)
        ]
    assert np.linalg.norm(ours) <= 1.2 * np.linalg.norm(theirs)


@pytest.mark.ci
def test_noisy_fixes_predict_no_worse_than_a_similarity_to_the_same_fixes(survey: Survey) -> None:
    """Four fixes that are wrong by 0.1 m place the rest to about 0.1 m, whatever is fitted."""
    ours, theirs = [], []
    for seed in range(DRAWS):
        noise = SIGMA_M * np.random.default_rng(seed).standard_normal(survey.truth.shape)
        noise[:, 2] = 0.0
        for given in halves(survey):
            mine, similarity, found = survey.predicted(given, noise)
            ours.append(mine)
            theirs.append(similarity)
            # A straight line of fixes shows no tilt about it.
            assert not found.frame.level
    assert np.linalg.norm(ours) <= 1.2 * np.linalg.norm(theirs)
    exact = [survey.predicted(given, 0.0 * noise)[1] for given in halves(survey)]
    limit = np.hypot(1.2 * np.sqrt(np.mean(np.square(exact))), 1.5 * SIGMA_M)
    assert np.median(ours) <= limit


@pytest.mark.ci
@pytest.mark.parametrize("number", SURVEYS)
def test_fixes_alone_place_a_survey_on_the_earth(
    number: int, aquaflow: Cli, shared_data: Path, tmp_path: Path
) -> None:
    """Of a line of stills that look down, nothing but the ground says what is level."""
    folder = shared_data / f"auv_survey_{number}"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    rows = list(csv.DictReader((folder / "positions_geotiff.csv").open()))
    truth = np.array([(float(row["northing_m"]), float(row["easting_m"]), 0.0) for row in rows])
    latitude, longitude = latitude_longitude(truth - truth[0], ORIGIN)
    table, dive = tmp_path / "fixes.csv", tmp_path / "dive"
    places = enumerate(zip(latitude, longitude, strict=True))
    lines = [f"{i},{a:.9f},{b:.9f},0.05" for i, (a, b) in places]
    table.write_text("\n".join(["t_s,latitude_deg,longitude_deg,sigma_m", *lines]))
    ran = aquaflow(
        "map", folder, "--fps", 1, "--telemetry", table, "--telemetry-offset", 0,
        "--tracking-only", "--out", dive,
    )  # fmt: skip
    assert ran.code == 0, ran.err
    frame = read_dive(dive).frame
    assert frame.georeferenced
    assert frame.scale_sigma < 0.06
    assert frame.heading_sigma_rad < np.radians(3.5)
    found = np.loadtxt(dive / "trajectory.tum")[:, 1:3] @ (1.0, 1.0j)
    true = truth[:, :2] @ (1.0, 1.0j)
    found, true = found - found.mean(), true - true.mean()
    assert np.sqrt(np.mean(np.abs(found - true) ** 2)) < 0.02 * np.abs(np.diff(true)).sum()
    assert abs(np.degrees(np.angle(np.vdot(found, true)))) < 2.0
    fixes = read_dive(dive).fixes
    assert [fix.picture for fix in fixes] == [row.source for row in read_dive(dive).frames]
    errors = np.array([(fix.error_north_m, fix.error_east_m) for fix in fixes]) @ (1.0, 1.0j)
    np.testing.assert_allclose(errors - errors.mean(), found - true, atol=0.03)
    numbers = read_dive(dive).metrics["fixes"]
    assert (numbers["count"], numbers["rejected"]) == (len(rows), 0)
    assert numbers["rms_m"] == pytest.approx(np.sqrt(np.mean(np.abs(errors) ** 2)), abs=1e-3)
    assert numbers["rms_sigmas"] < 1.5
    report = (dive / "report.html").read_text()
    assert "<h2>Position fixes</h2>" in report
    assert all(f"<td>{fix.picture}</td>" in report for fix in fixes)
