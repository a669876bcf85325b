"""What /health says of telemetry and of the metric frame."""

from __future__ import annotations

import json
from pathlib import Path

from aquaflow.dive.metric_outputs import metric_frame_numbers
from aquaflow.live.checkpoint.resume import Choice
from aquaflow.live.feed import LatestSamples
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.report import newest_values, report
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Lights,
    Position,
    UtcTime,
    Velocity,
)
from tests.live.live_scenes import VEHICLE, Clock, ToldFeed
from tests.metric_scenes import metric_frame


def test_the_newest_value_of_every_source_and_kind_is_shown_with_its_unit_and_age() -> None:
    clock = Clock()
    latest = LatestSamples(clock)
    for sample in (
        Depth(0, 0, "bar30", 4.0),
        Depth(1, 1, "bar30", 4.56789),
        Attitude(0, 0, "autopilot", (0.5**0.5, 0.0, 0.0, -(0.5**0.5))),
        AngularRate(0, 0, "imu", (0.1, 0.2, 0.3)),
        Acceleration(0, 0, "imu", (0.0, 0.0, -9.81)),
        Velocity(0, 0, "dvl", (0.5, 0.0, 0.01), 0.002),
        Altitude(0, 0, "dvl", 1.5),
        Lights(0, 0, "autopilot", 0.75),
        Position(0, 0, "usbl", 63.4300001, 10.39, 1.0),
        UtcTime(0, 0, "clock", 1_795_365_000_250_000_000),
    ):
        latest.take(sample)
    clock.pass_(2.04)
    latest.take(Altitude(0, 0, "ping", 1.6))

    shown = json.loads(json.dumps(newest_values(latest.latest())))

    assert shown["bar30"] == {"depth": {"value": 4.568, "unit": "m", "age_s": 2.0}}
    assert shown["ping"]["altitude"] == {"value": 1.6, "unit": "m", "age_s": 0.0}
    assert shown["autopilot"]["attitude"]["value"] == [0.0, 0.0, 270.0]
    assert shown["autopilot"]["lights"]["value"] == 0.75
    assert shown["dvl"]["velocity"] == {"value": [0.5, 0.0, 0.01], "unit": "m/s", "age_s": 2.0}
    assert shown["usbl"]["position"]["value"] == [63.4300001, 10.39]
    assert shown["clock"]["utc_time"]["value"] == "2026-11-22T16:30:00.250Z"
    assert set(shown["imu"]) == {"angular_rate", "acceleration"}


def test_the_metric_frame_is_shown_with_its_sigmas_and_why_a_source_is_not_used() -> None:
    shown = metric_frame_numbers(metric_frame())
    assert (shown["metric"], shown["metres_per_map_unit"], shown["scale_sigma"]) == (
        True, 2.5, 0.004
    )  # fmt: skip
    assert (shown["level"], shown["gravity_sigma_deg"]) == (True, 0.172)
    assert shown["north"] == "true north"
    assert shown["sources"]["bar30 depth"] == {"used": 480, "rejected": 3, "reason": ""}
    assert shown["sources"]["compass attitude"]["reason"] == "magnetic <disturbance>"


def test_an_unknown_frame_says_why_and_states_no_number() -> None:
    shown = metric_frame_numbers(WorldFrame.unknown("no telemetry could be used"))
    assert (shown["metric"], shown["level"]) == (False, False)
    assert shown["metres_per_map_unit"] is shown["scale_sigma"] is shown["gravity_sigma_deg"]
    assert "no telemetry could be used" in shown["scale_source"]


def test_the_report_of_a_live_dive_holds_both(tmp_path: Path) -> None:
    feed = ToldFeed()
    feed.latest_samples.take(Depth(0, 0, "bar30", 4.0))
    with LiveDive("shown", Choice(tmp_path / "dive"), feed, VEHICLE) as dive:
        said = json.loads(json.dumps(report(dive.parts, hang_s=1e6)))
    assert said["telemetry"]["bar30"]["depth"]["value"] == 4.0
    assert said["metric_frame"]["metric"] is False
