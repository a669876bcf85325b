"""MAVLink by way of mavlink2rest: the same samples as from the packets, and answers on the way."""

from __future__ import annotations

import json
import logging
import math
import random
import socket
import struct
import sys
from importlib import import_module
from typing import Any, get_args

import pytest

from aquaflow.base.errors import ConfigError, InputError
from aquaflow.config.telemetry import MavlinkConfig, MavlinkSource, parse_telemetry
from aquaflow.drivers.link import LinkLostError
from aquaflow.drivers.protocol.mavlink import MavlinkDecoder
from aquaflow.drivers.telemetry import LinkTelemetry
from aquaflow.drivers.transport import opener
from aquaflow.drivers.transport.mavlink2rest import binary
from aquaflow.recordings.telemetry_log import DecodedReads, Read
from aquaflow.sim_drivers.devices.ardusub import ArduSub
from aquaflow.sim_drivers.devices.device import SimulatedDevice
from aquaflow.sim_drivers.devices.mavlink2rest import Mavlink2restWire
from aquaflow.sources.outbound import NamedValue, StatusText
from aquaflow.types import Altitude, Attitude, Depth, TelemetrySample
from tests.drivers.simulated_links import AUTOPILOT, MAVLINK, motion, until

DIALECT: Any = import_module("pymavlink.dialects.v20.ardupilotmega")
COUNT = 1000
NOW = 50_000_000_000
KINDS = [
    *get_args(MavlinkSource),
    *("SCALED_PRESSURE2", "RC_CHANNELS", "SERVO_OUTPUT_RAW", "HEARTBEAT", "TIMESYNC", "ODOMETRY"),
]


def settings(**changes: Any) -> dict[str, Any]:
    link = {"kind": "mavlink2rest", "url": "ws://127.0.0.1:6040"}
    return {"kind": "mavlink", "link": link, **changes}


def decoder(**changes: Any) -> MavlinkDecoder:
    return MavlinkDecoder("rov", MavlinkConfig.model_validate(settings(**changes)))


def any_message(name: str, draw: random.Random) -> Any:
    """A message with any values, NaN among them."""
    made = getattr(DIALECT, f"MAVLink_{name.lower()}_message")
    lengths = dict(zip(made.ordered_fieldnames, made.array_lengths, strict=True))
    values: dict[str, Any] = {}
    for field, kind in zip(made.fieldnames, made.fieldtypes, strict=True):
        several = [_value(made, field, kind, draw) for _ in range(lengths[field] or 1)]
        values[field] = several if lengths[field] else several[0]
    return made(**values)


def _value(made: Any, field: str, kind: str, draw: random.Random) -> float:
    if kind == "float":
        single = struct.unpack("f", struct.pack("f", draw.uniform(-1.0, 1.0)))[0]
        return draw.choice([float(single)] * 9 + [math.nan])
    if made.fielddisplays_by_name.get(field) == "bitmask":
        names = DIALECT.enums[made.fieldenums_by_name[field]]
        return sum(draw.sample([flag for flag in names if flag & (flag - 1) == 0], k=3))
    if field in made.fieldenums_by_name:
        names = DIALECT.enums[made.fieldenums_by_name[field]]
        return draw.choice([n for n, e in names.items() if not e.name.endswith("ENUM_END")])
    bits = 8 * struct.calcsize({"8": "B", "1": "H", "3": "I", "6": "Q"}[kind.strip("uint_")[0]])
    if kind.startswith("u"):
        return draw.randrange(1 << draw.choice([bits, bits - 2]))
    return draw.randrange(-(1 << (bits - 1)), 1 << (bits - 1))


@pytest.mark.parametrize("name", KINDS)
def test_every_report_becomes_the_packet_that_it_was_made_of(name: str) -> None:
    draw, sender = random.Random(name), DIALECT.MAVLink(None, srcSystem=1, srcComponent=194)
    wires = [Mavlink2restWire(version_1=True), Mavlink2restWire(version_1=False)]
    mismatches = 0
    for k in range(COUNT):
        sender.seq = k % 256
        packet = bytes(any_message(name, draw).pack(sender))
        message = sender.decode(bytearray(packet))
        header = {"system_id": 1, "component_id": 194, "sequence": message.get_seq()}
        report = {"header": header, "message": wires[k % 2].body(message)}
        mismatches += binary(DIALECT, json.dumps(report)) != packet
    for wire in wires:
        wire.close()
    assert mismatches == 0


PUBLISHED = """{"header": {"system_id": 1, "component_id": 1, "sequence": 37}, "message": {
    "type": "ATTITUDE", "time_boot_ms": 49624892, "roll": 0.14528612792491913,
    "pitch": 0.012282482348382473, "yaw": -2.570211410522461,
    "rollspeed": -0.00008160166908055544, "pitchspeed": -0.0007044915109872818,
    "yawspeed": -0.00017313705757260323}}"""


def test_a_published_report_is_read() -> None:
    attitude, rate = decoder().feed(binary(DIALECT, PUBLISHED), NOW)
    assert isinstance(attitude, Attitude)
    w, x, y, z = attitude.wxyz
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    assert yaw == pytest.approx(-2.570211410522461)
    assert rate.rate_rad_s[2] == pytest.approx(-0.00017313705757260323)


@pytest.mark.parametrize(
    "text",
    ['"None"', '{"error": "no"}', "Could not convert input message.", "[" * 100_000, "{}"],
)
def test_what_is_no_report_is_nothing(text: str) -> None:
    assert binary(DIALECT, text) == b""


def test_reports_that_are_not_as_mavlink_has_them_are_counted_and_harm_nothing() -> None:
    draw, receiver = random.Random(3), decoder(messages=list(get_args(MavlinkSource)))
    wire = Mavlink2restWire()
    values = [None, "x", -1, 10**30, 1.5, [], {}, {"type": "x"}, {"bits": "x"}, [1, "a"], True]
    bad = 0
    for _ in range(3000):
        name = draw.choice([*KINDS, "NO_SUCH", "__INIT__", None, 7])
        body = wire.template(name)["message"] if name in KINDS else {"type": name}
        for key in draw.sample([*body], k=min(len(body), draw.randrange(4))):
            body[key] = draw.choice(values)
        header = draw.choice([{"system_id": 1, "component_id": 1}, {}, None, {"system_id": "1"}])
        data = binary(DIALECT, json.dumps({"header": header, "message": body}))
        bad += not data.startswith(b"\xfd")
        receiver.feed(data, NOW)
    wire.close()
    assert bad > 1000
    assert receiver.counters.garbage_bytes > 1000
    assert receiver.counters.messages > 100


def served(wire: Mavlink2restWire, scheme: str, path: str = "", **changes: Any) -> LinkTelemetry:
    link = {"kind": "mavlink2rest", "url": f"{scheme}://127.0.0.1:{wire.port}{path}"}
    config = {"devices": {"rov": {**MAVLINK, "link": link, **changes}}}
    return LinkTelemetry(parse_telemetry(config, "test"))


@pytest.mark.parametrize("path", ["", "/mavlink2rest", "/mavlink2rest/v1/ws/mavlink"])
def test_a_websocket_brings_what_a_serial_port_would(path: str) -> None:
    wire = Mavlink2restWire(prefix=path.removesuffix("/v1/ws/mavlink"))
    telemetry = served(wire, "ws", path)
    until(lambda: wire.clients == 1)
    simulated = SimulatedDevice(ArduSub(), wire, motion(), 4.0).start()
    until(simulated.finished.is_set)
    until(lambda: telemetry.counters()["rov"].samples >= 11 * 20)
    telemetry.close()
    simulated.close()
    heard = list(telemetry.samples())
    assert {type(sample) for sample in heard} == AUTOPILOT
    assert [s.altitude_m for s in heard if isinstance(s, Altitude)] == pytest.approx(
        [3.0 + k / 20 for k in range(20)], abs=0.006
    )
    assert telemetry.counters()["rov"].garbage_bytes == 0


def test_polling_reads_each_new_message_once_and_nothing_that_is_old() -> None:
    wire, device = Mavlink2restWire(), ArduSub()
    for packet in device.encode(Depth(0, 0, "log", 77.0), 10**9, 10**9):
        wire.send(packet)  # long before anybody asks
    telemetry = served(wire, "http", messages=["ATTITUDE"], lights=None)
    link = telemetry.links["rov"]
    until(lambda: link.is_open)
    simulated = SimulatedDevice(device, wire, motion(60), 1.0).start()
    until(simulated.finished.is_set)
    until(lambda: telemetry.counters()["rov"].samples > 10)
    telemetry.close()
    simulated.close()
    heard = list(telemetry.samples())
    depths = [s.depth_m for s in heard if isinstance(s, Depth)]
    truth = [s.depth_m for s in motion(60) if isinstance(s, Depth)]
    assert 0 < len(depths) <= len(truth)
    assert depths == sorted(set(depths))
    assert all(min(abs(a - b) for b in truth) < 0.006 for a in depths)
    assert {s.source for s in heard} <= {"rov/ATTITUDE", "rov/SCALED_PRESSURE2"}


@pytest.mark.parametrize("scheme", ["ws", "http"])
@pytest.mark.parametrize("version_1", [True, False])
def test_the_autopilot_hears_heartbeats_sentences_and_values(scheme: str, version_1: bool) -> None:
    wire, device = Mavlink2restWire(version_1), ArduSub()
    heard: list[Any] = []
    device.vision.take = lambda message, now_ns: heard.append(message)  # type: ignore[method-assign]
    telemetry = served(wire, scheme)
    until(lambda: telemetry.links["rov"].is_open)
    simulated = SimulatedDevice(device, wire, motion(3), 1.0).start()
    telemetry.send(StatusText("warning", "Scale is not known yet"))
    telemetry.send(NamedValue(NOW, "af_lag", 0.25))
    kinds = {"HEARTBEAT", "TIMESYNC", "STATUSTEXT", "NAMED_VALUE_FLOAT"}
    until(lambda: {message.get_type() for message in heard} >= kinds)
    until(lambda: device.answers > 0 or scheme == "http")  # to TIMESYNC of the autopilot's own
    telemetry.close()
    simulated.close()
    assert wire.refused == []
    by_kind = {message.get_type(): message for message in heard}
    assert by_kind["STATUSTEXT"].text == "Scale is not known yet"
    assert by_kind["STATUSTEXT"].severity == DIALECT.MAV_SEVERITY_WARNING
    assert by_kind["NAMED_VALUE_FLOAT"].value == 0.25
    assert by_kind["HEARTBEAT"].type == DIALECT.MAV_TYPE_ONBOARD_CONTROLLER
    assert {message.get_srcComponent() for message in heard} == {197}


def test_a_service_that_refuses_is_named_once(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    wire = Mavlink2restWire()
    monkeypatch.setattr(wire, "post", lambda text: False)
    with caplog.at_level(logging.WARNING):
        telemetry = served(wire, "ws")
        until(lambda: "does not send" in caplog.text)
        telemetry.send(StatusText("info", "once more"))
        until(lambda: wire.clients == 1)
        telemetry.close()
    wire.close()
    assert caplog.text.count("does not send") == 1
    assert "rov: mavlink2rest does not send HEARTBEAT: Failed to parse message" in caplog.text


def test_a_websocket_that_ends_is_opened_again() -> None:
    wire = Mavlink2restWire()
    telemetry = served(wire, "ws", talk=False)
    until(lambda: wire.clients == 1)
    wire.say(json.loads(PUBLISHED))
    until(lambda: telemetry.counters()["rov"].samples == 2)
    wire.unplug()
    until(lambda: wire.clients == 1)
    wire.say(json.loads(PUBLISHED))
    until(lambda: telemetry.counters()["rov"].samples == 4)
    assert telemetry.counters()["rov"].reconnects == 1
    telemetry.close()
    wire.close()


def test_what_a_websocket_says_beside_reports_is_left_out() -> None:
    wire = Mavlink2restWire()
    telemetry = served(wire, "ws", talk=False)
    until(lambda: wire.clients == 1)
    for text in ("Ok(())", '{"error": "no"}', PUBLISHED):
        wire.say_text(text)
    until(lambda: telemetry.counters()["rov"].samples == 2)
    assert telemetry.counters()["rov"].garbage_bytes == 0
    telemetry.close()
    wire.close()


def test_a_recording_of_the_link_is_one_of_mavlink() -> None:
    wire, reads = Mavlink2restWire(), list[Read]()
    link = {"kind": "mavlink2rest", "url": f"ws://127.0.0.1:{wire.port}"}
    config = parse_telemetry({"devices": {"rov": {**MAVLINK, "link": link}}}, "test")
    telemetry = LinkTelemetry(config, lambda name, at, data: reads.append(Read(name, at, data)))
    until(lambda: wire.clients == 1)
    simulated = SimulatedDevice(ArduSub(), wire, motion(), 4.0).start()
    until(lambda: telemetry.counters()["rov"].samples >= 11 * 20)
    telemetry.close()
    simulated.close()
    live: list[TelemetrySample] = list(telemetry.samples())
    again = list(DecodedReads(dict(config.devices)).samples(iter(reads)))
    assert [s.source for s in again] == [s.source for s in live]
    assert [s.arrival_ns for s in again] == [s.arrival_ns for s in live]


@pytest.mark.parametrize("scheme", ["ws", "http"])
def test_nobody_at_the_address_is_lost_in_words(scheme: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    url = f"{scheme}://127.0.0.1:{port}"
    config = MavlinkConfig.model_validate(settings(link={"kind": "mavlink2rest", "url": url}))
    open_link = opener("rov", config.link, decoder())
    with pytest.raises(LinkLostError, match=f"127.0.0.1:{port}"):
        open_link().read(1.0)


@pytest.mark.parametrize("scheme", ["ws", "http"])
def test_another_service_at_the_address_is_lost_in_words(
    scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    wire = Mavlink2restWire()
    monkeypatch.setattr(wire, "last_message", lambda path: 1 / 0)
    url = f"{scheme}://127.0.0.1:{wire.port}" + ("/elsewhere" if scheme == "ws" else "")
    config = MavlinkConfig.model_validate(settings(link={"kind": "mavlink2rest", "url": url}))
    with pytest.raises(LinkLostError, match="mavlink2rest"):
        opener("rov", config.link, decoder())().read(1.0)
    wire.close()


def test_a_missing_library_is_one_sentence_and_polling_needs_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "websockets", None)
    by_websocket = MavlinkConfig.model_validate(settings())
    with pytest.raises(InputError, match=r"websockets.*pip install 'aquaflow\[telemetry\]'"):
        opener("rov", by_websocket.link, decoder())
    link = {"kind": "mavlink2rest", "url": "http://127.0.0.1:6040"}
    opener("rov", MavlinkConfig.model_validate(settings(link=link)).link, decoder())


@pytest.mark.parametrize("url", ["192.168.2.2:6040", "https://x", "ws://x?filter=.*", "ws://"])
def test_an_address_that_cannot_be_is_refused(url: str) -> None:
    device = settings(link={"kind": "mavlink2rest", "url": url})
    with pytest.raises(ConfigError, match=r"link.*url"):
        parse_telemetry({"devices": {"rov": device}}, "rov.yaml")
