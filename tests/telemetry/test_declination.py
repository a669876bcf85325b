"""Magnetic and true north."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timezone

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import ConfigError
from aquaflow.config import FusionConfig, parse_config
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.telemetry.building import declination_of
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.types import Attitude, Position, UtcTime
from tests.telemetry.simulated_dives import Swum, estimated, swum

SECOND = 1_000_000_000
TRONDHEIM, KOBE, POLE = (63.43, 10.39), (34.69, 135.20), (86.0, 142.0)
AUTUMN = datetime(2026, 11, 22, tzinfo=timezone.utc)


def heard(
    place: tuple[float, float] | None = TRONDHEIM,
    date: datetime | None = AUTUMN,
    gnss: str = "topside/RMC",
) -> Telemetry:
    """An ArduSub's attitude, and what a receiver says of place and date."""
    telemetry = Telemetry()
    for k in range(10):
        t_ns = k * SECOND
        telemetry.add(Attitude(t_ns, t_ns, "rov/ATTITUDE", (1.0, 0.0, 0.0, 0.0)))
        if place is not None:
            telemetry.add(Position(t_ns, t_ns, gnss, *place, 1.0))
        if date is not None:
            utc_ns = int(date.timestamp()) * SECOND + t_ns
            telemetry.add(UtcTime(t_ns, t_ns, gnss, utc_ns))
    return telemetry


def degrees(telemetry: Telemetry, **settings: object) -> float | None:
    found = declination_of(telemetry, parse_config({"fusion": settings}, "test").fusion)
    return None if found is None else float(np.degrees(found))


def test_the_declination_is_that_of_the_place_and_the_year() -> None:
    assert degrees(heard(TRONDHEIM)) == pytest.approx(5.3, abs=0.2)
    assert degrees(heard(KOBE)) == pytest.approx(-8.2, abs=0.2)
    years = [degrees(heard(TRONDHEIM, AUTUMN.replace(year=year))) for year in (2016, 2023, 2034)]
    assert years == sorted(years)


def test_a_vehicle_that_knows_its_place_has_added_the_declination_itself() -> None:
    assert degrees(heard(gnss="rov/GPS_RAW_INT")) == 0.0


@pytest.mark.parametrize(
    "telemetry",
    [Telemetry(), heard(place=None), heard(date=None), heard(POLE)],
    ids=["silence", "no place", "no date", "near the magnetic pole"],
)
def test_what_cannot_be_known_is_not_guessed(telemetry: Telemetry) -> None:
    assert degrees(telemetry) is None


def test_the_settings_come_first() -> None:
    assert degrees(heard(), declination="none") is None
    assert degrees(heard(place=None), declination=-3.5) == pytest.approx(-3.5)
    with pytest.raises(ConfigError, match="declination"):
        degrees(heard(), declination=200)


@pytest.fixture(scope="module")
def dive() -> Swum:
    """Its compass shows magnetic north, five degrees east of the true one."""
    found = swum(SyntheticConfig(seed=3, frames=80, fps=4.0))
    turn = Rotation.from_euler("z", -5.0, degrees=True)
    telemetry = Telemetry()
    for sample in found.dive.samples:
        if isinstance(sample, Attitude):
            turned = turn * Rotation.from_quat(sample.wxyz, scalar_first=True)
            w, x, y, z = turned.as_quat(scalar_first=True).tolist()
            telemetry.add(replace(sample, wxyz=(w, x, y, z)))
        else:
            telemetry.add(sample)
    return replace(found, telemetry=telemetry)


def yaw_error_deg(dive: Swum, config: FusionConfig) -> tuple[float, str]:
    frame = estimated(dive, **dict(config)).frame
    apart = frame.T_nm.R @ dive.T_nm.R.T
    return float(np.degrees(np.arctan2(apart[1, 0], apart[0, 0]))), frame.north


def test_the_world_is_turned_to_true_north_by_the_declination(dive: Swum) -> None:
    unknown, magnetic = yaw_error_deg(dive, FusionConfig(declination="none"))
    known, true = yaw_error_deg(dive, FusionConfig(declination=5.0))
    assert (magnetic, true) == ("magnetic north", "true north")
    assert known - unknown == pytest.approx(5.0, abs=0.2)
