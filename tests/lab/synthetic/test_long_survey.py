"""The survey of an hour: its plan, its events, and what its instruments measure."""

from __future__ import annotations

from collections import Counter

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.lab.synthetic.streams import Instrument
from aquaflow.lab.synthetic.survey import FPS, SurveyPictures
from aquaflow.lab.synthetic.survey_plan import (
    HOUR_S,
    LAMP_FAILS_AT,
    NOTHING_S,
    SILT_AT,
    SILT_S,
    SPEED_M_S,
    TURBID_AT,
    Conditions,
    EndlessLines,
    LongDive,
)
from aquaflow.lab.synthetic.survey_telemetry import DEPTH_M, SurveyTelemetry
from aquaflow.telemetry.start import camera_in_body
from aquaflow.types import Attitude, Depth, Velocity

WIDTH = 96
PICTURE_M = 1.9


@pytest.fixture(scope="module")
def hour() -> SurveyPictures:
    return SurveyPictures(WIDTH, plan=LongDive())


def brightness(survey: SurveyPictures, t: float) -> npt.NDArray[np.float64]:
    """[W] of the columns of the picture at ``t`` s."""
    return np.asarray(survey.frame(round(t * FPS)).image.mean(axis=(0, 2), dtype=np.float64))


def structure(survey: SurveyPictures, t: float) -> float:
    """Grey levels between neighbouring pixels at ``t`` s."""
    grey = survey.frame(round(t * FPS)).image.mean(axis=-1)
    return float(np.abs(np.diff(grey, axis=1)).mean())


def calm(survey: SurveyPictures) -> float:
    return structure(survey, 1500.0)


def test_a_picture_of_the_hour_depends_on_its_index_alone(hour: SurveyPictures) -> None:
    late = hour.frame(35_999).image
    assert (SurveyPictures(WIDTH, plan=LongDive()).frame(35_999).image == late).all()
    assert not (hour.frame(35_998).image == late).all()


def test_the_vehicle_keeps_its_speed_for_the_whole_dive() -> None:
    t = np.arange(0.0, HOUR_S, 1.0 / FPS)
    steps = np.linalg.norm(np.diff(LongDive().place(t), axis=0), axis=1)
    assert steps.max() < SPEED_M_S / FPS + 1e-9
    assert steps.sum() == pytest.approx(SPEED_M_S * HOUR_S, rel=0.02)


@pytest.mark.parametrize("plan", [EndlessLines(), LongDive(), LongDive(600.0)])
def test_velocities_are_those_of_the_places(plan: EndlessLines | LongDive) -> None:
    t = np.linspace(0.5, 599.5, 3001)
    moved = (plan.place(t + 1e-4) - plan.place(t - 1e-4)) / 2e-4
    right = np.linalg.norm(moved - plan.velocity(t), axis=1) < 1e-6
    assert right.mean() > 0.998


def test_places_are_seen_again_after_half_of_the_dive() -> None:
    dive = LongDive()
    t = np.arange(0.0, HOUR_S, 1.0)
    places = dive.place(t)
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1) < PICTURE_M / 4.0
    first, second = np.nonzero(apart)
    waits = (t[second] - t[first])[second > first]
    assert waits.max() > 1800.0
    assert ((waits > 1500.0) & (waits < 2000.0)).any()


@pytest.mark.parametrize("duration_s", [300.0, 1800.0, HOUR_S])
def test_three_areas_lie_side_by_side_in_dives_of_any_length(duration_s: float) -> None:
    x = np.sort(LongDive(duration_s).place(np.arange(0.0, duration_s, 0.1))[:, 0])
    assert x[0] < -12.0
    assert x[-1] > 24.0


def test_for_twenty_seconds_nothing_is_seen_once_blue_and_once_black(hour: SurveyPictures) -> None:
    plan = hour.plan
    assert isinstance(plan, LongDive)
    for middle, blue in zip(plan.dark_s, (True, False), strict=True):
        for t in (middle - NOTHING_S / 2.0, middle, middle + NOTHING_S / 2.0):
            assert structure(hour, t) < 0.35 * calm(hour)
            red, _, deep = hour.frame(round(t * FPS)).image.mean(axis=(0, 1))
            assert (deep > red + 20) if blue else (deep < 5)
        assert structure(hour, middle + NOTHING_S / 2.0 + 3.0) > 0.5 * calm(hour)


def test_silt_hides_and_turbid_water_dims_the_seabed(hour: SurveyPictures) -> None:
    for share in SILT_AT:
        assert hour.plan.conditions(share * HOUR_S + SILT_S / 2.0).silt == 1.0
    assert hour.plan.conditions(1000.0).silt == 0.0
    begin, end = TURBID_AT[0]
    assert structure(hour, (begin + end) / 2.0 * HOUR_S) < 0.6 * calm(hour)


class LampsAt(EndlessLines):
    """The same places by other lamps."""

    def __init__(self, left: float, right: float) -> None:
        self.lamps = (left, right)

    def conditions(self, t: float) -> Conditions:
        return Conditions(lamps=self.lamps)


def test_a_lamp_that_fails_leaves_its_side_darker(hour: SurveyPictures) -> None:
    both, left, right = (
        brightness(SurveyPictures(WIDTH, plan=LampsAt(*levels)), 30.0)
        for levels in ((1.0, 1.0), (1.0, 0.0), (0.0, 1.0))
    )
    half = WIDTH // 2
    assert right.sum() < 0.85 * both.sum()
    assert (right / left)[:half].mean() < 0.97
    assert (right / left)[half:].mean() > 1.03
    fails = LAMP_FAILS_AT * HOUR_S
    levels = {hour.plan.conditions(fails + s).lamps for s in (-1.0, 0.1, 0.4, 1.9, 3.0)}
    assert levels == {(1.0, 1.0), (0.0, 1.0)}


def test_the_endless_survey_is_by_daylight_alone() -> None:
    assert EndlessLines().conditions(1e5).lamps is None


# --- instruments ----------------------------------------------------------------------------------


def test_instruments_measure_the_dive_that_the_pictures_show(hour: SurveyPictures) -> None:
    telemetry = SurveyTelemetry(hour)
    for index in (0, 777, 20_000):
        true = hour.T_wc(index)
        t = np.array([index / FPS])
        T_wc = telemetry.motion.T_wc(t)[0]
        assert np.abs(T_wc[:3, :3] - true.R).max() < 1e-9
        assert np.abs(T_wc[:3, 3] - true.t - [0.0, 0.0, DEPTH_M]).max() < 1e-9


def test_the_stated_mounting_is_the_true_one_but_for_its_error(hour: SurveyPictures) -> None:
    mountings = SurveyTelemetry(hour).mountings
    stated = camera_in_body(mountings.stated).R
    assert np.abs(stated - mountings.R_bc_stated).max() < 1e-9
    assert np.arccos((np.trace(stated.T @ mountings.R_bc) - 1.0) / 2.0) < np.radians(5.0)


def test_samples_come_by_arrival_at_their_rates_with_their_errors(hour: SurveyPictures) -> None:
    telemetry = SurveyTelemetry(hour)
    samples = list(telemetry.samples(600.0, ("depth", "attitude", "velocity")))
    arrivals = [sample.arrival_ns for sample in samples]
    assert arrivals == sorted(arrivals)
    counts = Counter(type(sample) for sample in samples)
    assert counts[Depth] == 6001
    assert counts[Attitude] == 12_001
    assert 2700 < counts[Velocity] <= 3001
    dvl = [sample for sample in samples if isinstance(sample, Velocity)]
    t = np.array([sample.t_ns for sample in dvl]) * 1e-9
    measured = np.array([sample.velocity_m_s for sample in dvl])
    errors = measured - telemetry.motion.velocity_b(t) @ telemetry.mountings.R_bd
    # By the median: samples at a corner of the way have either leg's velocity.
    sigma = 1.4826 * np.median(np.abs(errors - np.median(errors, axis=0)), axis=0)
    assert sigma == pytest.approx(0.01, rel=0.1)
    depths = np.array([sample.depth_m for sample in samples if isinstance(sample, Depth)])
    assert np.abs(depths - DEPTH_M).max() < 1.5


def test_instruments_that_are_not_aboard_say_nothing(hour: SurveyPictures) -> None:
    aboard: tuple[Instrument, ...] = ("depth",)
    samples = list(SurveyTelemetry(hour).samples(10.0, aboard))
    assert {type(sample) for sample in samples} == {Depth}
