"""The calibration check on exact geometry: right and wrong cameras, motion that shows nothing."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aquaflow.dive.calibration_pass import to_json, verdict, warning
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.prior.contract import Keypoints
from aquaflow.tracking import calibration_check
from aquaflow.tracking.calibration_check import (
    MAX_VIEWS,
    MIN_VIEWS,
    LensError,
    estimate,
    lens_error,
    most_turning,
    pairs_of,
    view_of,
)
from aquaflow.tracking.lens_equations import adjust_lens, match_pixels
from tests.tracking.lens_scenes import FOCAL_PX, HALF, swim

CALIBRATION = CameraModel(480, 360, FOCAL_PX, FOCAL_PX, 240.0, 180.0, "radtan", (0.05, 0, 0, 0))


def test_a_right_calibration_is_left_alone() -> None:
    error = estimate(*swim((0.0, 0.0)))

    assert not error.wrong
    assert verdict(error) == "fits"
    assert abs(error.log_focal) < 4.0 * error.sigma[0]
    assert abs(error.radial) < 4.0 * error.sigma[1]


@pytest.mark.parametrize("lens", [(0.06, 0.0), (-0.1, 0.0), (0.0, 0.066), (-0.05, -0.06)])
def test_a_wrong_focal_length_or_distortion_is_found_and_measured(
    lens: tuple[float, float],
) -> None:
    error = estimate(*swim(lens))

    assert error.wrong
    assert error.named == (lens[0] != 0.0, lens[1] != 0.0)
    assert np.abs([error.log_focal - lens[0], error.radial - lens[1]]).max() < 0.01
    assert error.noise_fitted < error.noise_given


@settings(max_examples=4, deadline=None)
@given(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), st.integers(0, 1000), st.floats(0.05, 0.15))
def test_an_error_that_good_calibrations_have_is_never_a_warning(
    focal: float, radial: float, seed: int, turning: float
) -> None:
    assert not estimate(*swim((focal, radial), turning=turning, seed=seed)).wrong


def test_a_camera_that_does_not_turn_says_nothing_of_its_focal_length() -> None:
    error = estimate(*swim((0.06, 0.0), turning=0.0))

    assert not error.known[0]
    assert not error.wrong
    assert verdict(error) == "cannot be told"
    assert to_json(error, CALIBRATION)["focal_px"] is None


def test_an_error_that_no_lens_has_is_no_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    def astray(*given: Any, terms: int) -> Any:
        found = adjust_lens(*given, terms=terms)
        return replace(found, adjusted=replace(found.adjusted, lens=found.adjusted.lens + 1.0))

    monkeypatch.setattr(calibration_check, "adjust_lens", astray)

    with pytest.raises(np.linalg.LinAlgError, match="determine no error"):
        estimate(*swim((0.0, 0.0)))


def test_mismatches_do_not_move_the_estimate() -> None:
    observations, R, centres = swim((0.0, 0.066))
    rng = np.random.default_rng(3)
    bad = rng.random(len(observations.matches)) < 0.08
    observations.matches[bad] = rng.uniform(-HALF, HALF, (int(bad.sum()), 2))

    error = estimate(observations, R, centres)

    assert error.wrong
    assert abs(error.radial - 0.066) < 0.01


def test_a_lens_with_further_terms_leaves_the_first_ones_uncertain() -> None:
    plain = estimate(*swim((0.0, 0.0)))
    further = estimate(*swim((0.0, 0.0, 0.3, 0.0, 0.01)))

    assert (further.sigma > 2.0 * plain.sigma).any()


def test_the_run_of_keyframes_that_turns_most_is_chosen() -> None:
    turns = [0.0] * 10 + [0.1, 0.0] * 5 + [0.0] * 4
    keyframes = [keyframe(i, turn) for i, turn in enumerate(turns)]

    chosen = most_turning(keyframes)

    assert len(chosen) == MAX_VIEWS
    assert 9 <= chosen[0].number <= 12


def test_a_run_ends_where_its_sub_map_ends() -> None:
    keyframes = [keyframe(i, 0.1 * (i % 2), sub_map=int(i >= 3)) for i in range(8)]

    assert [each.number for each in most_turning(keyframes)] == [3, 4, 5, 6, 7]


def test_too_few_keyframes_or_matches_say_nothing() -> None:
    assert lens_error([]) is None
    assert lens_error([keyframe(i, 0.1) for i in range(MIN_VIEWS - 1)]) is None
    assert lens_error([keyframe(i, 0.1) for i in range(MIN_VIEWS)]) is None


def test_keyframes_at_one_place_that_see_the_same_say_nothing() -> None:
    still = [keyframe(0, 0.0, keypoints=200) for _ in range(6)]
    found = lens_error(still)
    assert found is None or (not found.wrong and not found.known[0])


def test_a_keypoint_seen_in_several_keyframes_is_one_point() -> None:
    keyframes = [keyframe(i, 0.0, keypoints=200) for i in range(3)]

    observations = match_pixels([view_of(each) for each in keyframes], pairs_of(3))

    assert observations is not None
    assert len(observations.points) == 200
    assert len(observations.matches) == 2 * 200
    assert set(observations.reference) == {0}
    assert set(observations.view) == {1, 2}


@pytest.mark.parametrize(
    ("excess", "words"), [((0.064, 0.0), "1500 px"), ((0.0, 0.066), "k1 of 0.116")]
)
def test_the_warning_says_what_how_sure_and_what_to_do(
    excess: tuple[float, float], words: str
) -> None:
    camera = CameraModel(1360, 1023, 1407.0, 1407.0, 680.0, 511.0, "radtan", (0.05, 0, 0, 0))
    error = LensError(*excess, np.array([0.002, 0.002]), 3e-9, 1e-3, 5e-4, 5e-4, 8, 1500)

    said = warning(error, camera)

    assert words in said
    assert "instead of" in said
    assert "more than a million" in said
    assert "leave out --calib" in said
    assert ("focal length of" in said) == (excess[0] > 0.0)


def keyframe(number: int, turn: float, sub_map: int = 0, keypoints: int = 2) -> Any:
    """One that is turned about its optical axis by ``turn``, and always sees the same."""
    rng = np.random.default_rng(0)
    seen = Keypoints(
        rng.uniform(0.0, 300.0, (keypoints, 2)).astype(np.float32),
        rng.normal(0.0, 1.0, (keypoints, 64)).astype(np.float32),
    )
    pose = Sim3(so3_exp(np.array([0.0, 0.0, turn])), np.array([0.1 * number, 0.0, 0.0]))
    encoding = SimpleNamespace(keypoints=seen, camera=CALIBRATION)
    return SimpleNamespace(number=number, sub_map=sub_map, T_wc=pose, encoding=encoding)
