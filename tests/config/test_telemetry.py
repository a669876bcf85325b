"""The config of telemetry devices: kinds, unknown keys by their path, values that cannot be."""

from __future__ import annotations

import pytest
import yaml

from aquaflow.base.errors import ConfigError
from aquaflow.config.instruments import WaterLinkedSerialConfig
from aquaflow.config.telemetry import MavlinkConfig, TelemetryConfig, parse_telemetry

VEHICLE = """
devices:
  autopilot:
    kind: mavlink
    link: {kind: udp, port: 14550}
    lights: {channel: 13}
  dvl:
    kind: waterlinked_serial
    link: {kind: serial, port: /dev/serial/by-id/usb-dvl, baud: 115200}
    mounting: {position_m: [0.1, 0.0, 0.25], yaw_deg: 180}
  bus:
    kind: nmea2000
    link: {kind: can, channel: can0}
    assume: {level: true}
"""


def parsed(text: str) -> TelemetryConfig:
    return parse_telemetry(yaml.safe_load(text), "rov.yaml")


def test_devices_are_told_apart_by_their_kind():
    devices = parsed(VEHICLE).devices

    assert isinstance(devices["autopilot"], MavlinkConfig)
    assert devices["autopilot"].external_pressure == "SCALED_PRESSURE2"
    assert isinstance(devices["dvl"], WaterLinkedSerialConfig)
    assert devices["dvl"].mounting.yaw_deg == 180
    assert devices["bus"].link.interface == "socketcan"


def test_the_effective_config_can_be_written_and_read_again():
    config = parsed(VEHICLE)

    assert parsed(yaml.safe_dump(config.model_dump(mode="json"))) == config


@pytest.mark.parametrize(
    ("written", "instead", "sentence"),
    [
        ("baud: 115200", "bauds: 9600", r"'devices\.dvl\..*link\.serial\.bauds' is not a known"),
        ("yaw_deg: 180", "yaw: 3.1", r"'devices\.dvl\..*mounting\.yaw' is not a known key"),
        ("level: true", "levle: true", r"'devices\.bus\..*assume\.levle' is not a known key"),
        ("kind: mavlink", "kind: mavlnik", r"'devices\.autopilot' .*'mavlnik'"),
        ("kind: udp", "kind: can", r"'devices\.autopilot\.mavlink\.link' .*'can'"),
        ("port: 14550", "port: 70000", r"'devices\.autopilot\..*\.port' .*65535"),
        ("channel: 13", "channel: 17", r"lights\.channel' .*16"),
        ("channel: 13", "channel: 1, off_us: 1500, full_us: 1500", "off_us and full_us must"),
        ("devices:", "sensors:", "'sensors' is not a known key"),
    ],
)
def test_a_mistake_is_one_sentence_with_its_path(written, instead, sentence):
    assert written in VEHICLE
    with pytest.raises(ConfigError, match=rf"rov\.yaml: .*{sentence}"):
        parsed(VEHICLE.replace(written, instead))


@pytest.mark.parametrize(
    ("mapping", "sentence"),
    [
        ({"sample": "velocity", "signals": ["x", "y"]}, "made of 3 signals"),
        ({"sample": "attitude", "signals": ["r", "p", "y"]}, "made of 4 signals"),
        ({"sample": "depth", "signals": ["z"], "scale": [1, 1]}, "1 or 1 values"),
        ({"sample": "heave", "signals": ["z"]}, "depth"),
    ],
)
def test_a_signal_map_that_makes_no_sample_is_refused(mapping, sentence):
    link = {"kind": "can", "channel": "can0"}
    samples = [{"message": "M", **mapping}]
    device = {"kind": "dbc", "link": link, "database": "x.dbc", "samples": samples}

    with pytest.raises(ConfigError, match=sentence):
        parse_telemetry({"devices": {"bus": device}}, "rov.yaml")
