"""Which way is up on a dive's ground, with gravity and without."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.shown_views import ShownViews, on_ground
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.survey.export.ortho.ground import ALONG_GRAVITY, ground_of
from aquaflow.survey.export.ortho.survey import overview_png
from aquaflow.survey.measure.answers import answer
from aquaflow.survey.measure.asked import MapPoint
from aquaflow.survey.measure.finished_dive import numbers_of_dive
from aquaflow.telemetry.world_frame import WorldFrame
from tests.mapping.mapping_scenes import gaussians_at
from tests.metric_scenes import metric_frame
from tests.survey.export.survey_scenes import ALTITUDE_M, DEPTH_M, surveyed, write_survey

Array = np.ndarray

UPRIGHT = metric_frame(T_nm=Sim3.identity())
UNKNOWN = WorldFrame.unknown()
UP = np.array([0.0, 0.0, -1.0])


def tilted(degrees: float, frame: WorldFrame = UPRIGHT) -> Mapper:
    """The survey, of whose pictures each shows the same ground, from so far aside."""
    mapper = surveyed(frame)
    inside = frame.T_nm.inverse()
    for view in mapper.views:
        T_nc = frame.pose(view.T_wc)
        turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
        below = T_nc.t + np.array([0.0, 0.0, ALTITUDE_M])
        T = inside @ Sim3(turn @ T_nc.R, below - ALTITUDE_M * (turn @ [0.0, 0.0, 1.0]))
        view.T_wc = Sim3(T.R, T.t)
    return mapper


def up_of(mapper: Mapper, frame: WorldFrame) -> Array:
    """[3] in the world of the sub-map."""
    return np.asarray(ground_of(on_ground(frame, mapper), mapper).T_gm.R[2])


@pytest.mark.parametrize("degrees", [0.0, -12.0, 20.0])
def test_without_gravity_up_is_across_the_ground_and_not_against_the_cameras(
    degrees: float,
) -> None:
    mapper = tilted(degrees)
    assert np.degrees(np.arccos(up_of(mapper, UNKNOWN) @ UP)) < 2.0
    said = ground_of(on_ground(UNKNOWN, mapper), mapper).vertical
    assert said == "perpendicular to the mean plane of the ground; gravity is unknown"


@pytest.mark.parametrize("degrees", [45.0, -65.0])
def test_an_oblique_view_has_no_ground_without_gravity_and_has_one_with_it(degrees: float) -> None:
    mapper = tilted(degrees)
    assert on_ground(UNKNOWN, mapper) is UNKNOWN
    with pytest.raises(InputError, match=r"look squarely.*measure level.*--telemetry"):
        ground_of(UNKNOWN, mapper)
    assert on_ground(UPRIGHT, mapper) is UPRIGHT
    assert ground_of(UPRIGHT, mapper).vertical == ALONG_GRAVITY


def test_what_is_no_plane_has_no_ground() -> None:
    mapper = surveyed(UPRIGHT)
    ball = np.random.default_rng(0).standard_normal((4000, 3))
    places = [2.0, 2.0, DEPTH_M] + 0.8 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    mapper.scene.gaussians = gaussians_at(
        torch.from_numpy(places), torch.full((len(places), 3), 0.5, dtype=torch.float64), 0.04
    )
    for number, view in enumerate(mapper.views):  # all around it
        turn = Rotation.from_euler("y", 22.5 * number, degrees=True).as_matrix()
        view.T_wc = Sim3(turn, np.array([2.0, 2.0, DEPTH_M]) - 2.5 * turn[:, 2])
    assert on_ground(UNKNOWN, mapper) is UNKNOWN


def numbers(folder: Path, mapper: Mapper, frame: WorldFrame) -> dict[str, float]:
    dive = write_survey(folder, mapper, on_ground(frame, mapper))
    for name in ("trajectory.csv", "medium.json"):
        (dive / name).write_text("{}")
    read = Dive(dive, poses=[], medium_facts={}, main=0)
    found = numbers_of_dive(read, folder, cell=0.1)
    return {each.key: each.quantity.value for each in found.numbers}


def test_a_turned_dive_has_the_same_numbers(tmp_path: Path) -> None:
    mapper, turn = surveyed(UPRIGHT), metric_frame().T_nm.R
    plain = numbers(tmp_path / "plain", mapper, UNKNOWN)
    turned = surveyed(metric_frame(T_nm=Sim3(turn.T, np.zeros(3))))
    other = numbers(tmp_path / "turned", turned, UNKNOWN)
    assert set(plain) == set(other) >= {"rugosity", "slope_median", "mapped_share"}
    for key, value in plain.items():
        assert other[key] == pytest.approx(value, rel=0.02), key


def test_an_oblique_dive_keeps_what_needs_no_vertical(tmp_path: Path) -> None:
    dive = Dive(write_survey(tmp_path / "dive", tilted(60.0), UNKNOWN))
    corners = [MapPoint(x, y, DEPTH_M) for x, y in ((1.0, 1.0), (1.0, 2.0), (2.0, 2.0), (2.0, 1.0))]
    found = answer(dive, list(corners), "area", tmp_path)
    assert set(found.quantities) == {"area"}
    assert found.quantities["area"].value == pytest.approx(1.0, rel=0.05)
    assert "look squarely" in found.notes[0]
    with pytest.raises(InputError, match="look squarely"):
        answer(dive, list(corners[:2]), "profile", tmp_path)
    with pytest.raises(InputError, match="look squarely"):
        overview_png(dive.filled_map(), UNKNOWN)


def test_open_water_is_never_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = surveyed(UPRIGHT)
    mapper.medium.set_water(*(torch.tensor([0.3, 0.2, 0.1]) for _ in range(3)))
    height = mapper.views[0].camera.height

    def upper_half(view: object, lit: torch.Tensor, shown: object) -> torch.Tensor:
        found = torch.zeros(lit.shape[:2], dtype=torch.bool)
        found[: height // 2] = True
        return found

    monkeypatch.setattr(mapper.scene, "open_water", upper_half)
    shown = ShownViews(mapper)
    view, points = mapper.views[0], shown.points()[0].places
    v = view.camera.project((points - view.T_wc.t) @ view.T_wc.R)[:, 1]
    assert v.min() >= 0.5 * height
    # North of every camera is water; between the first and the last of them there are votes.
    north = np.array([0.3, 3.6])
    places = np.column_stack([north, [2.0, 2.0], [DEPTH_M, DEPTH_M]])
    assert shown.in_open_water(places).tolist() == [False, True]
