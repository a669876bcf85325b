"""Which statement of the camera's mounting a live dive uses."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.config.stage import MountingConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.live.checkpoint.resume import Choice
from aquaflow.live.feed import camera_mounting
from aquaflow.live.live_dive import LiveDive
from tests.live.live_scenes import ToldFeed

FUSION, OWN, POSE = (MountingConfig(yaw_deg=angle) for angle in (10.0, 20.0, 30.0))


@pytest.mark.parametrize(
    ("fusion", "own", "pose_enabled", "used"),
    [
        (FUSION, OWN, True, FUSION),
        (None, OWN, True, OWN),
        (None, None, True, POSE),
        (None, None, False, None),
    ],
)
def test_the_first_that_states_the_mounting_is_believed(
    fusion: MountingConfig | None,
    own: MountingConfig | None,
    pose_enabled: bool,
    used: MountingConfig | None,
) -> None:
    vehicle = VehicleConfig.model_validate(
        {
            "fusion": {"camera": fusion},
            "service": {"pose": {"enabled": pose_enabled, "mounting": POSE}},
        }
    )
    feed = ToldFeed()
    feed.mounting = own
    assert camera_mounting(vehicle, vehicle.service, feed) == used


def test_a_live_dive_passes_the_mounting_to_its_fusion(tmp_path: Path) -> None:
    feed = ToldFeed()
    feed.mounting = OWN
    vehicle = VehicleConfig.model_validate({"threads": 1})
    with LiveDive("mounted", Choice(tmp_path / "dive"), feed, vehicle) as dive:
        assert dive.parts.slam.metric.mounting == OWN
