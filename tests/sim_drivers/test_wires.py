"""Wires of simulated devices: unplugged by the test, used by the device's own thread."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from aquaflow.sim_drivers.devices.wires import TcpWire


@pytest.fixture
def wire() -> Iterator[TcpWire]:
    wire = TcpWire()
    yield wire
    wire.close()


def heard(wire: TcpWire, said: bytes) -> bytes | None:
    """What the device receives from a new client that says this."""
    with socket.create_connection(("127.0.0.1", wire.port)) as client:
        client.sendall(said)
        while (data := wire.receive()) is None:
            pass
        return data


def test_a_connection_closed_while_the_device_reads_it_makes_room_for_the_next(
    wire: TcpWire, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert heard(wire, b"first") == b"first"
    connected = wire._client
    assert connected is not None
    with monkeypatch.context() as patch:
        # As if another thread unplugged it after the device had looked for a client.
        patch.setattr(wire, "_accept", lambda: connected)
        wire.unplug()
        assert wire.receive() is None
    assert heard(wire, b"second") == b"second"
