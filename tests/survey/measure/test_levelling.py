"""``aquaflow measure level`` gives a dive its vertical: by points on a plane, or by a pitch."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.ply import read_ply
from aquaflow.dive.trajectory_csv import read_trajectory_csv
from aquaflow.dive.tum import read_tum
from aquaflow.survey.measure.levelling import Vertical, make_level, of_pitch, plane_of
from aquaflow.survey.measure.notes import Note, read_notes, write_notes
from aquaflow.survey.measure.points import MeasuredPoints
from aquaflow.survey.measure.reframing import level, metric, reframe
from aquaflow.survey.measure.viewpoints import Viewpoint, read_viewpoints, write_viewpoints
from aquaflow.survey.report.report_of import report_of
from aquaflow.telemetry.known_lengths.known_length import KnownLength, scale_of
from aquaflow.telemetry.metric_file import read_metric_file, write_metric_file
from aquaflow.telemetry.world_frame import GRAVITY, SourceReport, WorldFrame
from tests.command_line import Cli, refused

PITCH_DEG = 41.9
"""Below the horizon, mean, of the small dive's camera (poses.tum of its recording)."""
AHEAD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""R_nc of a camera that looks north, level."""


@pytest.fixture
def dive(small_dive: Path, tmp_path: Path) -> Path:
    """That telemetry said nothing of."""
    folder = Path(shutil.copytree(small_dive, tmp_path / "dive"))
    reframe(Dive(folder), 0, WorldFrame.unknown())
    return folder


def down_of(dive: Path) -> np.ndarray:
    """[3] down in the world of the sub-map."""
    return read_metric_file(dive)[0].T_nm.R[2]


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:  # [3] unit each
    return float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0))))


def test_the_cameras_pitch_gives_the_vertical_that_telemetry_had(
    dive: Path, small_dive: Path, command: Cli
) -> None:
    ran = command("measure", "level", dive, "--camera-pitch", PITCH_DEG)
    assert ran.code == 0, ran.err
    assert "known to 2 degrees" in ran.out
    assert angle_deg(down_of(dive), down_of(small_dive)) < 2.0
    frame = read_metric_file(dive)[0]
    assert (frame.level, frame.metric, frame.north) == (True, False, "initial heading")
    assert np.degrees(frame.tilt_sigma_rad) == pytest.approx(2.0)
    assert frame.sources[-1].kind == GRAVITY
    metrics = json.loads((dive / "metrics.json").read_text())
    assert metrics["gravity_sigma_deg"] == pytest.approx(2.0)
    assert "z down" in (dive / "trajectory.tum").read_text().splitlines()[0]


def test_every_file_is_turned_alike(dive: Path) -> None:
    place = np.array([[0.5, -0.25, 2.0]])
    write_notes(dive, [Note("a", "crack", "Point", place)], WorldFrame.unknown())
    box = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    view = Viewpoint("b", "bow", None, tuple(place[0]), (1.0, 0.0, 0.0), crop=box)
    write_viewpoints(dive, [view], WorldFrame.unknown())
    before, splats = read_tum(dive / "trajectory.tum"), read_ply(dive / "map.ply")
    make_level(dive, lambda read: of_pitch(read, PITCH_DEG))
    frame = read_metric_file(dive)[0]
    R, after = frame.T_nm.R, read_tum(dive / "trajectory.tum")
    np.testing.assert_allclose(after.positions, before.positions @ R.T, atol=1e-8)
    np.testing.assert_allclose(after.R_wc, R @ before.R_wc, atol=1e-8)
    turned = read_ply(dive / "map.ply")
    np.testing.assert_allclose(turned.means, splats.means @ R.T, atol=1e-5)
    np.testing.assert_allclose(turned.scales, splats.scales, rtol=1e-5)
    [note] = read_notes(dive, frame)
    np.testing.assert_allclose(note.places, place @ R.T, atol=1e-9)
    [view] = read_viewpoints(dive, frame)
    assert view.place is not None
    np.testing.assert_allclose(view.place, (place @ R.T)[0], atol=1e-9)
    assert view.crop is not None
    low, high = np.array(view.crop, np.float64).reshape(2, 3)
    assert (low <= R @ np.ones(3) + 1e-9).all()
    assert (high >= R @ np.ones(3) - 1e-9).all()
    rows = read_trajectory_csv(dive / "trajectory.csv")
    np.testing.assert_allclose([(r.x, r.y, r.z) for r in rows], after.positions, atol=1e-6)
    pitches = [row.pitch_deg for row in rows]
    assert -np.mean(pitches) == pytest.approx(PITCH_DEG, abs=0.1)
    assert np.cos(np.radians(rows[0].heading_deg)) == pytest.approx(1.0)
    assert {row.speed_m_s for row in rows} == {None}


def test_level_then_level_again_is_level_once(dive: Path) -> None:
    def find(read: Dive) -> Vertical:
        return of_pitch(read, PITCH_DEG)

    make_level(dive, find)
    before, once = read_metric_file(dive)[0], read_tum(dive / "trajectory.tum")
    make_level(dive, find)
    after, twice = read_metric_file(dive)[0], read_tum(dive / "trajectory.tum")
    np.testing.assert_allclose(after.T_nm.R, before.T_nm.R, atol=1e-8)
    np.testing.assert_allclose(after.covariance, before.covariance, atol=1e-9)
    assert after.sources == before.sources
    np.testing.assert_allclose(twice.positions, once.positions, atol=1e-8)


def test_a_better_vertical_replaces_the_last(dive: Path, small_dive: Path) -> None:
    make_level(dive, lambda read: of_pitch(read, 30.0))
    make_level(dive, lambda read: of_pitch(read, PITCH_DEG, 1.0))
    assert angle_deg(down_of(dive), down_of(small_dive)) < 2.0
    [report] = [each for each in read_metric_file(dive)[0].sources if each.kind == GRAVITY]
    assert "41.9 degrees" in report.source


def test_metres_and_level_may_come_in_either_order() -> None:
    known = KnownLength(-1, "ruler", 0.5, 0.005, 1.5, 0.001, 0)
    scale = scale_of([known])
    assert scale is not None
    R, tilt = Rotation.from_rotvec([0.4, -0.2, 0.1]).as_matrix(), np.diag([1e-3, 2e-3])
    report = SourceReport("points on a level plane", GRAVITY, 4)
    one = metric(level(WorldFrame.unknown(), R, tilt, report), [known], scale)
    other = level(metric(WorldFrame.unknown(), [known], scale), R, tilt, report)
    np.testing.assert_allclose(one.T_nm.matrix, other.T_nm.matrix)
    np.testing.assert_allclose(one.covariance, other.covariance)
    assert one.metric is other.metric is one.level is other.level is True
    assert set(one.sources) == set(other.sources)


def test_the_ground_is_measured_along_gravity_then_and_the_map_drawn_from_above(
    dive: Path,
) -> None:
    (dive / "overview.png").unlink()
    metrics = json.loads((dive / "metrics.json").read_text())
    told = ["no map from above was drawn: nothing says which way is down", "kept"]
    (dive / "metrics.json").write_text(json.dumps(metrics | {"notes": told}))
    make_level(dive, lambda read: of_pitch(read, PITCH_DEG))
    assert json.loads((dive / "reef_numbers.json").read_text())["vertical"] == "along gravity"
    assert (dive / "overview.png").read_bytes().startswith(b"\x89PNG")
    report = report_of(Dive(dive))
    assert report.vertical == "along gravity"
    assert report.notes == ["kept"]


# --------------------------------------------------------------------------------------------------
# Points on something level.


def marked(places: np.ndarray, sigma: float = 0.01) -> MeasuredPoints:  # [N, 3]
    sigmas = np.full(len(places), sigma)
    return MeasuredPoints.round(places, sigmas, 0.0 * sigmas, 1.0)


def plane(normal: np.ndarray, count: int, noise: float = 0.0) -> np.ndarray:  # [3] unit
    """[count, 3] places on it, 2 by 1 wide."""
    random = np.random.default_rng(1)
    across = np.linalg.svd(normal[None])[2][1:]
    places = random.uniform(-1.0, 1.0, (count, 2)) * [2.0, 1.0] @ across
    return np.asarray(places + noise * random.standard_normal((count, 1)) * normal)


def looking_down(pitch_deg: float) -> np.ndarray:
    """[1, 3, 3] a camera in a level n."""
    pitch = Rotation.from_euler("y", -pitch_deg, degrees=True).as_matrix()
    return np.asarray((pitch @ AHEAD)[None])


@pytest.mark.parametrize("pitch_deg", [-40.0, 0.0, 45.0, 90.0, 120.0])
def test_a_level_plane_has_its_normal_down_whichever_way_the_cameras_look(
    pitch_deg: float,
) -> None:
    turn = Rotation.from_rotvec([0.5, -0.3, 1.0]).as_matrix()
    down = turn @ [0.0, 0.0, 1.0]
    found = plane_of(marked(plane(down, 5)), turn @ looking_down(pitch_deg), 2.0)
    assert angle_deg(found.down, down) < 1e-6
    assert found.covariance @ found.down == pytest.approx(np.zeros(3), abs=1e-12)
    assert found.sigma_deg > 2.0


def test_the_vertical_errs_as_its_sigma_says() -> None:
    down, ratios = np.array([0.0, 0.0, 1.0]), []
    for seed in range(200):
        noise = 0.05 * np.random.default_rng(seed).standard_normal((6, 1)) * down
        found = plane_of(marked(plane(down, 6) + noise, 0.05), looking_down(45.0), 1e-6)
        error = found.down[:2]
        ratios.append(error @ np.linalg.solve(found.covariance[:2, :2], error))
    assert np.mean(ratios) == pytest.approx(2.0, abs=0.6)  # chi-square of two


def test_points_on_one_line_are_no_plane() -> None:
    line = np.linspace(0.0, 1.0, 4)[:, None] * [1.0, 2.0, 0.5]
    with pytest.raises(InputError, match="one line"):
        plane_of(marked(line), looking_down(0.0), 2.0)


def test_points_of_pictures_give_the_vertical(dive: Path, command: Cli) -> None:
    """The reef's floor is roughly level."""
    frame = min(row.index for row in Dive(dive).frames if row.frame_class == "keyframe")
    points = [f"{frame}:{u},{v}" for u, v in ((20, 100), (140, 100), (20, 50), (140, 50))]
    given = [text for point in points for text in ("--point", point)]
    ran = command("measure", "level", dive, *given, "--sigma", 1.0, "--json")
    assert ran.code == 0, ran.err
    said = json.loads(ran.out)
    assert said["used"] == 4
    assert said["sigma_deg"] > 1.0
    assert read_metric_file(dive)[0].level


# --------------------------------------------------------------------------------------------------
# What is refused, in a sentence.


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ((), "give --point three times"),
        (("--camera-pitch", 20, "--point", "1,2,3"), "give --point three times"),
        (("--camera-pitch", 200), "within"),
        (("--camera-pitch", 20, "--sigma", 0), "positive"),
        (("--camera-pitch", 20, "--sigma", 9), "to 9.0 degrees"),
        (("--point", "0:80,60", "--point", "0:20,60"), "needs 3 points, not 2"),
        (("--point", "0:80", "--point", "1,2,3", "--point", "2,2,3"), "is no point"),
    ],
)
def test_what_gives_no_vertical_is_refused_and_changes_nothing(
    options: tuple[object, ...], sentence: str, dive: Path, command: Cli
) -> None:
    before = (dive / "trajectory.tum").read_bytes()
    ran = command("measure", "level", dive, *options)
    assert ran.code != 0
    assert sentence in " ".join(ran.err.replace("\u2502", " ").split())
    assert (dive / "trajectory.tum").read_bytes() == before
    assert not read_metric_file(dive)[0].level


def test_gravity_that_telemetry_measured_stays(small_dive: Path, command: Cli) -> None:
    ran = command("measure", "level", small_dive, "--camera-pitch", 30)
    refused(ran, small_dive)
    assert "telemetry has measured gravity" in ran.err


def test_a_dive_in_the_frame_of_another_stays_in_it(dive: Path, command: Cli) -> None:
    write_metric_file(dive, {0: replace(WorldFrame.unknown(), site="reef_1")}, main=0)
    assert "frame of reef_1" in command("measure", "level", dive, "--camera-pitch", 30).err
