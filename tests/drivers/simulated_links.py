"""One simulated device for every telemetry driver, and a log that they all speak from."""

from __future__ import annotations

import itertools
import math
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow.config.instruments import DbcSignal
from aquaflow.config.link import CanConfig
from aquaflow.config.telemetry import TelemetryConfig, parse_telemetry
from aquaflow.drivers.link import LinkCounters
from aquaflow.drivers.telemetry import LinkTelemetry
from aquaflow.drivers.transport import opener
from aquaflow.sim_drivers.devices.ardusub import ArduSub
from aquaflow.sim_drivers.devices.can_nodes import DbcNode, Nmea2000Instruments
from aquaflow.sim_drivers.devices.device import SimulatedDevice
from aquaflow.sim_drivers.devices.nmea_talker import NmeaTalker
from aquaflow.sim_drivers.devices.nucleus import Nucleus
from aquaflow.sim_drivers.devices.pd0 import Pd0Dvl
from aquaflow.sim_drivers.devices.ping import Ping1D
from aquaflow.sim_drivers.devices.vectornav import VectorNav
from aquaflow.sim_drivers.devices.waterlinked import WaterLinkedJson, WaterLinkedSerial
from aquaflow.sim_drivers.devices.wires import CanWire, PtyWire, TcpWire, UdpWire
from aquaflow.sim_drivers.faults import Faults, faulty
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Lights,
    Position,
    TelemetrySample,
    UtcTime,
    Velocity,
)
from tests.small_recording import GIVE_UP_S

SPEED = 4.0
STEPS = 20
RATE_HZ = 20.0

UTC_NS = 1_795_365_000_000_000_000
"""2026-11-22."""

ASSUME = {"level": True, "no_side_slip": True}

DBC = """
VERSION ""
NS_ :
BS_:
BU_: ROV
BO_ 2566834709 Dvl: 8 ROV
 SG_ Vx : 0|16@1- (0.001,0) [-30|30] "m/s" ROV
 SG_ Vy : 16|16@1- (0.001,0) [-30|30] "m/s" ROV
 SG_ Vz : 32|16@1- (0.001,0) [-30|30] "m/s" ROV
BO_ 291 Pressure: 4 ROV
 SG_ DepthMm : 0|32@1- (1,0) [-100000|10000000] "mm" ROV
"""
DBC_SIGNALS = [
    {"message": "Dvl", "sample": "velocity", "signals": ["Vx", "Vy", "Vz"], "sigma_m_s": 0.02},
    {"message": "Pressure", "sample": "depth", "signals": ["DepthMm"], "scale": [0.001]},
]


def motion(steps: int = STEPS) -> list[TelemetrySample]:
    """A vehicle that turns and dives, every quantity at 20 Hz, in the order of arrival."""
    samples: Iterable[TelemetrySample] = []
    for k in range(steps):
        s = k / RATE_HZ
        stamp = (5_000_000_000 + round(s * 1e9), 5_002_000_000 + round(s * 1e9), "log")
        q = np.roll(
            Rotation.from_euler("ZYX", [0.5 + 0.2 * s, 0.1, -0.05]).as_quat(canonical=True), 1
        )
        samples += [
            Acceleration(*stamp, (0.1, -0.2, -9.8)),
            AngularRate(*stamp, (0.01, -0.02, 0.2)),
            Attitude(*stamp, tuple(q)),
            Altitude(*stamp, 3.0 + s),
            Depth(*stamp, 10.0 + 0.5 * s),
            Velocity(*stamp, (0.4 + 0.01 * k, 0.1, -0.05), 0.02),
            Lights(*stamp, 0.5),
            Position(*stamp, -41.25 + 1e-6 * k, 174.8 + 2e-6 * k, 2.5),
            UtcTime(*stamp, UTC_NS + round(s * 1e9)),
        ]
    return samples


def endless(log: list[TelemetrySample], enough: threading.Event) -> Iterator[TelemetrySample]:
    """``log`` again and again, each time later, until it is ``enough``."""
    for late_ns in itertools.count(step=round(STEPS / RATE_HZ * 1e9)):
        for sample in log:
            if enough.is_set():
                return
            yield replace(
                sample, t_ns=sample.t_ns + late_ns, arrival_ns=sample.arrival_ns + late_ns
            )


@dataclass
class Rig:
    """A device on its wire, and the config by which the driver finds it."""

    protocol: Any
    wire: Any
    config: dict[str, Any]
    kinds: frozenset[type]
    """Samples that the protocol tells."""


def _pty(tmp_path: Path) -> tuple[PtyWire, dict[str, Any]]:
    path = tmp_path / "port"
    return PtyWire(path), {"kind": "serial", "port": str(path)}


def _can(interface: str, channel: str, **options: int) -> tuple[CanWire, dict[str, Any]]:
    link = {"kind": "can", "interface": interface, "channel": channel, "options": options}
    return CanWire(CanConfig.model_validate(link)), link


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


EARTH = frozenset({Position, UtcTime})
AUTOPILOT = EARTH | {Acceleration, AngularRate, Attitude, Altitude, Depth, Velocity, Lights}
DVL = frozenset({Velocity, Altitude})
MAVLINK = {
    "kind": "mavlink",
    "messages": [
        *("ATTITUDE", "RAW_IMU", "DISTANCE_SENSOR", "LOCAL_POSITION_NED"),
        *("GPS_RAW_INT", "SYSTEM_TIME"),
    ],
    "lights": {"channel": 9},
}


def mavlink_pty(tmp_path: Path) -> Rig:
    wire, link = _pty(tmp_path)
    return Rig(ArduSub(), wire, {**MAVLINK, "link": link}, AUTOPILOT)


def mavlink_udp(tmp_path: Path) -> Rig:
    port = free_port()
    link = {"kind": "udp", "host": "127.0.0.1", "port": port}
    wire = UdpWire(("127.0.0.1", port))
    return Rig(ArduSub(mavlink_2=False), wire, {**MAVLINK, "link": link}, AUTOPILOT)


def nmea_pty(tmp_path: Path) -> Rig:
    wire, link = _pty(tmp_path)
    config = {"kind": "nmea0183", "link": link, "assume": ASSUME}
    kinds = EARTH | {Attitude, Altitude, Depth, AngularRate, Velocity}
    return Rig(NmeaTalker(), wire, config, kinds)


def waterlinked_pty(tmp_path: Path) -> Rig:
    wire, link = _pty(tmp_path)
    config = {"kind": "waterlinked_serial", "link": link, "attitude": True}
    return Rig(WaterLinkedSerial(), wire, config, DVL | {Attitude})


def waterlinked_tcp(tmp_path: Path) -> Rig:
    wire = TcpWire()
    link = {"kind": "tcp", "host": "127.0.0.1", "port": wire.port}
    config = {"kind": "waterlinked_json", "link": link, "attitude": True}
    return Rig(WaterLinkedJson(), wire, config, DVL | {Attitude})


def pd0_pty(tmp_path: Path) -> Rig:
    wire, link = _pty(tmp_path)
    return Rig(Pd0Dvl(), wire, {"kind": "pd0", "link": link}, DVL)


def pd0_beams_pty(tmp_path: Path) -> Rig:
    wire, link = _pty(tmp_path)
    return Rig(Pd0Dvl("beam"), wire, {"kind": "pd0", "link": link}, DVL)


def pd0_earth_pty(tmp_path: Path) -> Rig:
    wire, link = _pty(tmp_path)
    return Rig(Pd0Dvl("earth"), wire, {"kind": "pd0", "link": link}, DVL)


def nucleus_pty(tmp_path: Path) -> Rig:
    wire, link = _pty(tmp_path)
    kinds = DVL | {Acceleration, AngularRate, Attitude, Depth}
    packets = ["bottom_track", "altimeter", "ahrs", "imu", "fast_pressure"]
    return Rig(Nucleus(), wire, {"kind": "nucleus", "link": link, "packets": packets}, kinds)


def ping_pty(tmp_path: Path) -> Rig:
    wire, link = _pty(tmp_path)
    config = {"kind": "ping", "link": link, "ask_for": "stream"}
    return Rig(Ping1D(streams=True), wire, config, frozenset({Altitude}))


def vectornav_pty(tmp_path: Path) -> Rig:
    wire, link = _pty(tmp_path)
    kinds = EARTH | {Acceleration, AngularRate, Attitude}
    return Rig(VectorNav(), wire, {"kind": "vectornav", "link": link}, kinds)


def vectornav_ascii_pty(tmp_path: Path) -> Rig:
    wire, link = _pty(tmp_path)
    kinds = frozenset({Acceleration, AngularRate, Attitude, Position})
    return Rig(VectorNav(ascii_messages=True), wire, {"kind": "vectornav", "link": link}, kinds)


def nmea2000_virtual(tmp_path: Path) -> Rig:
    wire, link = _can("virtual", str(tmp_path))
    config = {"kind": "nmea2000", "link": link, "assume": ASSUME}
    return Rig(Nmea2000Instruments(), wire, config, DVL | EARTH | {Attitude, AngularRate})


def nmea2000_multicast(tmp_path: Path) -> Rig:
    rig = nmea2000_virtual(tmp_path)
    rig.wire.close()
    wire, link = _can("udp_multicast", "239.74.163.2", port=free_port())
    return Rig(rig.protocol, wire, {**rig.config, "link": link}, rig.kinds)


def dbc_virtual(tmp_path: Path) -> Rig:
    database = tmp_path / "rov.dbc"
    database.write_text(DBC)
    wire, link = _can("virtual", str(tmp_path))
    config = {"kind": "dbc", "link": link, "database": str(database), "samples": DBC_SIGNALS}
    mappings = tuple(DbcSignal.model_validate(signal) for signal in DBC_SIGNALS)
    return Rig(DbcNode(str(database), mappings), wire, config, frozenset({Velocity, Depth}))


RIGS: dict[str, Callable[[Path], Rig]] = {
    build.__name__: build
    for build in (
        mavlink_pty, mavlink_udp, nmea_pty, waterlinked_pty, waterlinked_tcp, pd0_pty,
        pd0_beams_pty, pd0_earth_pty, nucleus_pty, ping_pty,
        vectornav_pty, vectornav_ascii_pty,
        nmea2000_virtual, nmea2000_multicast, dbc_virtual,
    )
}  # fmt: skip


class Running:
    """A driver that listens to a device."""

    def __init__(
        self, rig: Rig, samples: Iterable[TelemetrySample], faults: Faults | None, **device: Any
    ):
        config = telemetry_config(rig)
        links = {}
        self.injected: dict[str, int] = {}
        if faults is not None:
            opened = opener("device", config.devices["device"].link)
            links["device"], self.injected = faulty(opened, faults)
        self.telemetry = LinkTelemetry(config, links=links)
        self.rig = rig
        self.device = SimulatedDevice(rig.protocol, rig.wire, samples, **{"speed": SPEED, **device})

    @property
    def counters(self) -> LinkCounters:
        return self.telemetry.counters()["device"]

    @property
    def state(self) -> str:
        return self.telemetry.links["device"].state

    def wait_open(self) -> None:
        """A serial port forgets what came before it was opened."""
        until(lambda: self.telemetry.links["device"].is_open)

    def play(self) -> None:
        """Let the device say all its samples to the open link."""
        self.wait_open()
        self.device.start()
        assert self.device.finished.wait(GIVE_UP_S)

    def fetched(self) -> list[TelemetrySample]:
        """Stop, and everything that came."""
        self.telemetry.close()
        return list(self.telemetry.samples())


def telemetry_config(rig: Rig) -> TelemetryConfig:
    return parse_telemetry({"devices": {"device": rig.config}}, "test")


@contextmanager
def running(
    rig: Rig, samples: Iterable[TelemetrySample], faults: Faults | None = None, **device: Any
) -> Iterator[Running]:
    session = Running(rig, samples, faults, **device)
    try:
        yield session
    finally:
        session.device.close()
        session.telemetry.close()


def until(condition: Callable[[], bool]) -> None:
    """Wait for what other threads do."""
    deadline = time.monotonic() + GIVE_UP_S
    while not condition():
        assert time.monotonic() < deadline, "nothing happened"
        time.sleep(0.005)


def values(sample: TelemetrySample) -> np.ndarray:
    """What a sample tells, as a vector; a quaternion with w >= 0."""
    told = [
        getattr(sample, field.name)
        for field in fields(sample)
        if field.name not in ("t_ns", "arrival_ns", "source", "figure_of_merit_m_s", "sigma_m")
    ]
    if isinstance(sample, UtcTime):
        told = [1e-9 * (sample.utc_ns - UTC_NS)]
    vector = np.ravel(np.array(told, float))
    return vector * math.copysign(1.0, vector[0]) if isinstance(sample, Attitude) else vector
