"""The telemetry source: many links, one bounded queue, and a close that always returns."""

from __future__ import annotations

import sys
import threading
from importlib.metadata import entry_points

import pytest

from aquaflow.base.errors import InputError
from aquaflow.config.telemetry import parse_telemetry
from aquaflow.drivers.telemetry import LinkTelemetry
from aquaflow.recordings.telemetry_log import DecodedReads, Read
from aquaflow.sim_drivers.devices.device import SimulatedDevice, boot_clock
from aquaflow.sim_drivers.faults import jumping_clock
from aquaflow.sources import TELEMETRY
from aquaflow.types import Altitude, Depth, Velocity
from tests.drivers.simulated_links import (
    RIGS,
    endless,
    motion,
    running,
    telemetry_config,
    until,
)


def test_the_source_is_registered():
    (entry,) = entry_points(group=TELEMETRY, name="links")

    assert entry.load() is LinkTelemetry


def test_several_devices_are_heard_at_once_in_the_order_of_arrival(tmp_path):
    rigs = {}
    for name in ("pd0_pty", "nmea_pty"):
        (tmp_path / name).mkdir()
        rigs[name] = RIGS[name](tmp_path / name)
    config = parse_telemetry({"devices": {k: rig.config for k, rig in rigs.items()}}, "test")
    telemetry = LinkTelemetry(config)
    devices = [SimulatedDevice(rig.protocol, rig.wire, motion(), 4.0) for rig in rigs.values()]
    until(lambda: all(link.is_open for link in telemetry.links.values()))

    for device in devices:
        device.start()
    until(lambda: all(counters.samples >= 20 for counters in telemetry.counters().values()))
    telemetry.close()
    heard = list(telemetry.samples())
    for device in devices:
        device.close()

    assert {sample.source.split("/")[0] for sample in heard} == set(rigs)
    for name in rigs:
        arrivals = [s.arrival_ns for s in heard if s.source.startswith(name)]
        assert arrivals == sorted(arrivals)


def test_the_oldest_samples_give_way_and_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr("aquaflow.drivers.telemetry.QUEUE_SAMPLES", 10)
    rig = RIGS["nmea_pty"](tmp_path)
    telemetry = LinkTelemetry(telemetry_config(rig))
    device = SimulatedDevice(rig.protocol, rig.wire, motion(), None)
    until(lambda: telemetry.links["device"].is_open)

    device.start()
    until(device.finished.is_set)
    until(lambda: telemetry.counters()["device"].messages >= device.sent > 100)
    telemetry.close()
    heard = list(telemetry.samples())
    device.close()

    counters = telemetry.counters()["device"]
    assert len(heard) == 10
    assert counters.dropped_samples == counters.samples - 10
    assert [s.depth_m for s in heard if isinstance(s, Depth)][-1] == pytest.approx(10.475, abs=0.01)


def test_samples_are_referred_to_the_body(tmp_path):
    rig = RIGS["waterlinked_tcp"](tmp_path)
    rig.config["mounting"] = {"yaw_deg": 180, "position_m": [0, 0, 0.3]}
    with running(rig, motion(3)) as session:
        session.play()
        until(lambda: session.counters.samples >= 9)
        heard = session.fetched()

    velocity = next(s for s in heard if isinstance(s, Velocity))
    altitude = next(s for s in heard if isinstance(s, Altitude))
    assert velocity.velocity_m_s == pytest.approx((-0.4, -0.1, -0.05), abs=1e-3)
    assert altitude.altitude_m == pytest.approx(3.3, abs=0.01)


@pytest.mark.parametrize("name", ["mavlink_pty", "waterlinked_pty", "nmea_pty", "pd0_pty"])
def test_a_device_that_is_unplugged_and_replugged_is_heard_again(name, tmp_path):
    rig, enough = RIGS[name](tmp_path), threading.Event()
    with running(rig, endless(motion(), enough)) as session:
        session.wait_open()
        session.device.start()
        until(lambda: session.counters.samples > 5)
        rig.wire.unplug()
        until(lambda: not session.telemetry.links["device"].is_open)
        before = session.counters.samples
        rig.wire.plug()
        until(lambda: session.counters.samples > before)
        enough.set()
        assert session.counters.reconnects == 1


def test_a_tcp_device_that_closes_the_connection_is_heard_again(tmp_path):
    rig, enough = RIGS["waterlinked_tcp"](tmp_path), threading.Event()
    with running(rig, endless(motion(), enough)) as session:
        session.wait_open()
        session.device.start()
        until(lambda: session.counters.samples > 5)
        rig.wire.unplug()
        until(lambda: session.counters.reconnects == 1)
        before = session.counters.samples
        until(lambda: session.counters.samples > before)
        enough.set()


@pytest.mark.parametrize("jump_s", [3 * 3600, -300])
@pytest.mark.parametrize("name", ["mavlink_pty", "pd0_pty", "waterlinked_pty"])
def test_a_jump_of_the_devices_clock_moves_no_sample(name, jump_s, tmp_path):
    rig = RIGS[name](tmp_path)
    clock = jumping_clock(boot_clock, 400_000_000, jump_s * 1_000_000_000)
    with running(rig, motion(), clock=clock, speed=1.0) as session:
        session.play()
        until(lambda: session.counters.messages >= session.device.sent)
        heard = session.fetched()

    assert len(heard) >= 20
    assert all(0 <= s.arrival_ns - s.t_ns <= 2_000_000_000 for s in heard)


def test_a_timesync_is_agreed_on_with_an_autopilot(tmp_path):
    rig = RIGS["mavlink_udp"](tmp_path)
    with running(rig, motion(), speed=1.0) as session:
        assert session.telemetry.clocks() == {}
        session.play()
        until(lambda: session.telemetry.clocks()["device"].round_trips)
        until(lambda: rig.protocol.answers > 0 and rig.protocol.heartbeats > 0)


def test_closing_ends_whoever_waits_and_may_be_done_again(tmp_path):
    rig = RIGS["pd0_pty"](tmp_path)
    telemetry = LinkTelemetry(telemetry_config(rig))
    heard: list = []
    consumer = threading.Thread(target=lambda: heard.extend(telemetry.samples()))
    consumer.start()

    telemetry.close()
    telemetry.close()
    consumer.join(10)

    assert not consumer.is_alive()
    assert heard == []
    rig.wire.close()


def test_a_source_whose_devices_are_all_absent_closes(tmp_path):
    nobody = {"kind": "serial", "port": str(tmp_path / "nothing")}
    config = {"devices": {"a": {"kind": "pd0", "link": nobody}}}
    telemetry = LinkTelemetry(parse_telemetry(config, "test"))
    until(lambda: "cannot open" in telemetry.links["a"].reason)

    telemetry.close()

    assert list(telemetry.samples()) == []


def test_closing_does_not_wait_for_a_link_that_is_stuck(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("aquaflow.drivers.telemetry.CLOSE_TIMEOUT_S", 0.05)
    stuck = threading.Event()

    class StuckLink:
        name = "device"

        def read(self, timeout_s: float) -> bytes:
            stuck.wait()
            return b""

        def close(self) -> None: ...

    rig = RIGS["pd0_pty"](tmp_path)
    telemetry = LinkTelemetry(telemetry_config(rig), links={"device": StuckLink})
    until(lambda: telemetry.links["device"].is_open)

    telemetry.close()

    assert list(telemetry.samples()) == []
    assert "left behind" in caplog.text
    stuck.set()
    rig.wire.close()


def test_a_missing_library_is_one_sentence_and_starts_no_thread(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20.ardupilotmega", None)
    before = set(threading.enumerate())
    config = {"devices": {"rov": {"kind": "mavlink", "link": {"kind": "udp", "port": 14550}}}}

    with pytest.raises(InputError, match=r"'rov' needs the library pymavlink.*aquaflow\[telemetry"):
        LinkTelemetry(parse_telemetry(config, "test"))
    assert set(threading.enumerate()) <= before


@pytest.mark.parametrize(
    "name", ["ping_pty", "nucleus_pty", "vectornav_pty", "pd0_beams_pty", "pd0_earth_pty"]
)
def test_recorded_bytes_of_a_link_are_decoded_as_they_were_live(name, tmp_path):
    rig, reads = RIGS[name](tmp_path), []
    config = telemetry_config(rig)
    telemetry = LinkTelemetry(config, lambda link, at, data: reads.append(Read(link, at, data)))
    device = SimulatedDevice(rig.protocol, rig.wire, motion(), 4.0)
    until(lambda: telemetry.links["device"].is_open)
    device.start()
    until(device.finished.is_set)
    until(lambda: telemetry.counters()["device"].messages >= device.sent)
    telemetry.close()
    device.close()

    live = list(telemetry.samples())
    assert len(live) >= 20
    assert list(DecodedReads(dict(config.devices)).samples(iter(reads))) == live
