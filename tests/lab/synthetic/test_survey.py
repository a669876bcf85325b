"""The endless survey: pictures that depend on their index alone, of a seabed that never repeats."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.lab.synthetic.survey import ALTITUDE_M, FPS, SurveyPictures
from aquaflow.lab.synthetic.survey_plan import BETWEEN_LINES_M, LINE_M, SPEED_M_S

WIDTH = 96
ON_A_LINE = round(LINE_M / SPEED_M_S * FPS)
ROUND = round((LINE_M + BETWEEN_LINES_M) / SPEED_M_S * FPS)
"""Pictures on a line, and from the beginning of one to that of the next."""


@pytest.fixture(scope="module")
def survey() -> SurveyPictures:
    return SurveyPictures(WIDTH)


def grey(survey: SurveyPictures, index: int) -> npt.NDArray[np.float32]:
    return survey.frame(index).image.astype(np.float32).mean(axis=-1)


def correlation(a: npt.NDArray[np.float32], b: npt.NDArray[np.float32]) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def test_a_picture_depends_on_its_index_alone(survey: SurveyPictures) -> None:
    *_, last = survey.frames(12)
    assert last.index == 11
    assert (SurveyPictures(WIDTH).frame(11).image == last.image).all()
    assert not (SurveyPictures(WIDTH, seed=1).frame(11).image == last.image).all()


def test_frames_come_at_the_surveys_rate_with_the_camera_of_their_size(
    survey: SurveyPictures,
) -> None:
    frames = list(survey.frames(3))
    assert [frame.t_ns for frame in frames] == [0, 100_000_000, 200_000_000]
    assert frames[0].image.shape == (survey.camera.height, survey.camera.width, 3)
    assert frames[0].camera == survey.camera


@pytest.mark.parametrize("apart", [3, 8])
def test_poses_and_camera_say_where_a_place_is_seen_again(
    survey: SurveyPictures, apart: int
) -> None:
    first, second = 40, 40 + apart
    x, y, ahead, _ = survey._intersect_seabed(survey.T_wc(first))
    rays = survey.camera.unproject(survey.camera.pixel_centres())
    places = survey.T_wc(first).apply(rays * ahead[..., None])
    assert np.abs(places[..., 0] - x).max() < 0.01
    assert np.abs(places[..., 1] - y).max() < 0.01
    at = survey.camera.project(survey.T_wc(second).inverse().apply(places)) - 0.5
    shown = np.ascontiguousarray(at, np.float32)
    again = cv2.remap(grey(survey, second), shown[..., 0], shown[..., 1], cv2.INTER_LINEAR)
    size = (survey.camera.width - 1, survey.camera.height - 1)
    inside = ((shown > 0) & (shown < size)).all(axis=-1)
    assert inside.mean() > 0.5
    assert correlation(grey(survey, first)[inside], again[inside]) > 0.97


def test_rays_end_on_the_relief(survey: SurveyPictures) -> None:
    x, y, ahead, box = survey._intersect_seabed(survey.T_wc(70))
    assert box[0] <= x.min() <= x.max() <= box[2]
    assert box[1] <= y.min() <= y.max() <= box[3]
    assert 0.8 * ALTITUDE_M < ahead.min() < ahead.max() < 1.3 * ALTITUDE_M


def test_a_line_overlaps_with_the_one_before_it(survey: SurveyPictures) -> None:
    there, back = survey.T_wc(100), survey.T_wc(ROUND + ON_A_LINE - 100)
    height_m = ALTITUDE_M * survey.camera.height / survey.camera.fy
    assert abs(there.t[0] - back.t[0]) < 0.2
    assert 0.3 * height_m < back.t[1] - there.t[1] < 0.7 * height_m


def test_the_area_grows_with_the_frames(survey: SurveyPictures) -> None:
    length_m = 10_000 / FPS * SPEED_M_S
    lines = int(length_m / (LINE_M + BETWEEN_LINES_M))
    assert survey.T_wc(10_000).t[1] == pytest.approx(lines * BETWEEN_LINES_M, abs=0.2)
    assert np.linalg.norm(survey.T_wc(10_000).t - survey.T_wc(9_999).t) < 0.1


def test_nothing_repeats(survey: SurveyPictures) -> None:
    pictures = [grey(survey, 2 * ROUND * line) for line in range(8)]
    alike = [
        abs(correlation(a, b)) for i, a in enumerate(pictures) for b in pictures[i + 1 :]
    ]  # fmt: skip
    assert max(alike) < 0.6
    assert np.mean(alike) < 0.3
