"""Byte links on real ptys, sockets and CAN buses: what arrives, and how a loss shows."""

from __future__ import annotations

import os
import socket
import struct
import subprocess
import sys

import can
import pytest

from aquaflow.base.errors import InputError, load
from aquaflow.config.link import CanConfig, SerialConfig, TcpConfig, UdpConfig
from aquaflow.drivers.link import MAX_READ_BYTES, LinkLostError
from aquaflow.drivers.transport import opener
from aquaflow.drivers.transport.can import EXTENDED, RECORD, open_can
from aquaflow.drivers.transport.ports import open_serial, open_tcp, open_udp
from aquaflow.sim_drivers.devices.wires import CanWire, PtyWire, TcpWire, UdpWire
from tests.drivers.simulated_links import free_port, until

WAIT_S = 10.0


@pytest.fixture
def pty(tmp_path):
    wire = PtyWire(tmp_path / "port")
    link = open_serial("dvl", SerialConfig(port=str(wire.path)))
    yield wire, link
    link.close()
    wire.close()


def test_a_serial_port_carries_any_byte_both_ways(pty):
    wire, link = pty
    every = bytes(range(256))

    wire.send(every)
    heard = b""
    while len(heard) < len(every):
        heard += link.read(WAIT_S)
    link.write(every)

    assert heard == every
    until(lambda: (said := wire.receive()) is None or said == every)
    assert link.read(0.0) == b""


def test_an_unplugged_port_is_lost_and_found_again_under_its_path(pty):
    wire, link = pty

    wire.unplug()
    with pytest.raises(LinkLostError, match="the port was lost"):
        link.read(WAIT_S)
    with pytest.raises(LinkLostError, match="the port was lost"):
        link.write(b"hello")
    with pytest.raises(LinkLostError, match="cannot open"):
        open_serial("dvl", SerialConfig(port=str(wire.path)))

    wire.plug()
    again = open_serial("dvl", SerialConfig(port=str(wire.path)))
    wire.send(b"back")
    assert again.read(WAIT_S)
    again.close()


def test_a_closed_port_is_lost_and_may_be_closed_again(pty):
    _, link = pty
    link.close()
    link.close()

    with pytest.raises(LinkLostError):
        link.read(0.1)
    with pytest.raises(LinkLostError):
        link.write(b"hello")


def test_a_port_that_takes_nothing_is_lost_and_does_not_block(pty):
    _, link = pty
    with pytest.raises(LinkLostError):
        link.write(bytes(1_000_000))


def test_a_listening_udp_link_answers_whoever_spoke_last():
    port = free_port()
    link = open_udp("rov", UdpConfig(host="127.0.0.1", port=port))
    vehicle = UdpWire(("127.0.0.1", port))

    link.write(b"nobody is there yet")
    assert link.read(0.0) == b""
    vehicle.send(bytes(60_000))
    assert link.read(WAIT_S) == bytes(60_000)
    link.write(b"answer")
    until(lambda: vehicle.receive() == b"answer")

    vehicle.close()
    link.close()
    link.close()
    with pytest.raises(LinkLostError):
        link.read(0.1)


def test_a_sending_udp_link_speaks_first_and_outlives_a_refusal():
    vehicle = UdpWire()
    link = open_udp("rov", UdpConfig(mode="send", host="127.0.0.1", port=vehicle.port))

    link.write(b"hello")
    until(lambda: vehicle.receive() == b"hello")
    vehicle.send(b"hello you")
    assert link.read(WAIT_S) == b"hello you"
    vehicle.close()
    for _ in range(5):
        link.write(b"anybody?")
        assert link.read(0.01) == b""
    link.close()


def test_a_udp_port_in_use_is_lost():
    port = free_port()
    first = open_udp("rov", UdpConfig(host="127.0.0.1", port=port))
    with pytest.raises(LinkLostError, match=f"127.0.0.1:{port}"):
        open_udp("rov", UdpConfig(host="127.0.0.1", port=port))
    first.close()


def test_a_tcp_link_is_lost_when_the_device_closes():
    wire = TcpWire()
    link = open_tcp("dvl", TcpConfig(host="127.0.0.1", port=wire.port))

    assert wire.receive() is None  # accepts the connection
    wire.send(b"hello")
    assert link.read(WAIT_S) == b"hello"
    link.write(b"hello you")
    until(lambda: wire.receive() == b"hello you")
    wire.unplug()
    with pytest.raises(LinkLostError, match="closed the connection"):
        link.read(WAIT_S)
    link.close()
    with pytest.raises(LinkLostError):
        link.write(b"hello")
    wire.close()


def test_nobody_at_a_tcp_address_is_lost():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(LinkLostError, match=f"cannot connect to 127.0.0.1:{port}"):
        open_tcp("dvl", TcpConfig(host="127.0.0.1", port=port))


def bus(tmp_path) -> tuple[CanWire, CanConfig]:
    config = CanConfig(interface="virtual", channel=str(tmp_path))
    return CanWire(config), config


def test_can_frames_travel_as_the_kernels_records(tmp_path):
    wire, config = bus(tmp_path)
    link = open_can("bus", config)

    wire.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"ab"))
    wire.send(can.Message(arbitration_id=0x123, is_remote_frame=True, dlc=2))
    wire.send(can.Message(is_error_frame=True))
    wire.send(can.Message(arbitration_id=0x1234567, is_extended_id=True, data=bytes(range(8))))
    heard = b""
    while len(heard) < 2 * RECORD.size:
        heard += link.read(WAIT_S)

    assert heard == struct.pack("<IB3x8s", 0x123, 2, b"ab") + struct.pack(
        "<IB3x8s", 0x1234567 | EXTENDED, 8, bytes(range(8))
    )
    assert link.read(0.0) == b""
    link.write(heard)
    back = [wire.receive() for _ in range(2)]
    assert [(m.arbitration_id, m.is_extended_id, bytes(m.data)) for m in back] == [
        (0x123, False, b"ab"),
        (0x1234567, True, bytes(range(8))),
    ]
    wire.close()
    link.close()


def test_a_flood_of_frames_is_read_in_bounded_pieces(tmp_path):
    wire, config = bus(tmp_path)
    link = open_can("bus", config)
    for k in range(6000):
        wire.send(can.Message(arbitration_id=k % 2048, is_extended_id=False, data=b"abc"))

    pieces = [link.read(WAIT_S), link.read(WAIT_S)]

    assert max(map(len, pieces)) <= MAX_READ_BYTES
    assert sum(map(len, pieces)) == 6000 * RECORD.size
    wire.close()
    link.close()


def test_a_closed_bus_is_lost(tmp_path):
    wire, config = bus(tmp_path)
    link = open_can("bus", config)
    link.close()
    link.close()

    with pytest.raises(LinkLostError):
        link.read(0.1)
    wire.close()


@pytest.mark.parametrize(
    "settings",
    [
        {"interface": "socketcan"},
        {"interface": "no_such_interface"},
        {"interface": "udp_multicast", "bitrate": 250_000},
        {"interface": "virtual", "options": {"channel": "told twice"}},
    ],
)
def test_a_bus_that_is_not_there_is_lost(settings):
    config = CanConfig(channel="no_such_can9", **settings)
    with pytest.raises(LinkLostError, match=r"cannot join the CAN bus .* no_such_can9"):
        open_can("bus", config)


@pytest.mark.parametrize(
    ("module", "config"),
    [
        ("serial", SerialConfig(port="/dev/ttyUSB0")),
        ("can", CanConfig(channel="can0")),
    ],
)
def test_a_library_that_is_missing_is_one_sentence_before_anything_is_opened(
    monkeypatch, module, config
):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"{module}.*pip install 'aquaflow\[telemetry\]'"):
        opener("device", config)


def test_a_library_that_is_there_is_loaded():
    assert load("os", "nothing") is os


def test_the_drivers_load_their_libraries_only_when_a_device_needs_them():
    code = (
        "import sys, aquaflow.drivers.telemetry;"
        "print(*{'serial', 'can', 'cantools', 'pymavlink', 'torch', 'cv2'} & set(sys.modules))"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    assert ran.stdout.split() == []
