"""``aquaflow doctor devices`` on the network: real sockets, simulated devices, and what is none."""

from __future__ import annotations

import socket
import sys
import threading
from pathlib import Path

import pytest

from aquaflow.base.errors import InputError
from aquaflow.config.cameras import StreamConfig
from aquaflow.config.telemetry import TelemetryConfig
from aquaflow.drivers.network_discovery import conversation
from aquaflow.drivers.network_discovery.blueos import blueos_streams
from aquaflow.drivers.network_discovery.mavlink import mavlink_links
from aquaflow.drivers.network_discovery.onvif import onvif_cameras
from aquaflow.drivers.network_discovery.rtp import rtp_payload, rtp_streams
from aquaflow.drivers.network_discovery.rtsp import rtsp_streams
from aquaflow.drivers.network_discovery.waterlinked import NAME, waterlinked_dvls
from aquaflow.sim_drivers.devices.ardusub import ArduSub
from aquaflow.sim_drivers.devices.device import SimulatedDevice
from aquaflow.sim_drivers.devices.waterlinked import WaterLinkedJson
from aquaflow.sim_drivers.devices.wires import TcpWire, UdpWire
from aquaflow.sources.discovery import FoundDevice
from tests.drivers.network_servers import (
    HOST,
    http,
    rtp,
    tcp_server,
    udp_answerer,
    udp_sender,
)
from tests.drivers.simulated_links import endless, free_port, motion

NOBODY = 1
"""A port on which nothing listens."""
HERE = [HOST]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is not there is waited for less long; what is there answers at once."""
    monkeypatch.setattr(conversation, "CONNECT_S", 5.0)
    monkeypatch.setattr(conversation, "ANSWER_S", 0.3)


def camera(found: FoundDevice) -> StreamConfig:
    """The lines to paste, taken as a config."""
    return StreamConfig.model_validate(found.config)


def device(found: FoundDevice) -> object:
    return TelemetryConfig.model_validate({"devices": {"found": found.config}}).devices["found"]


# --- RTSP -----------------------------------------------------------------------------------------


def test_a_server_whose_streams_blueos_names_is_not_asked() -> None:
    endpoints = [f"rtsp://{HOST}:{NOBODY}/video"]
    information = {"endpoints": endpoints, "configuration": {"encode": "H264"}}
    stream = {"video_and_stream": {"name": "front", "stream_information": information}}
    with tcp_server(http({"/streams": [stream]})) as manager:
        assert rtsp_streams(HERE, [NOBODY], manager) == []
        assert [found.id for found in blueos_streams(HERE, manager)] == endpoints


def test_an_rtsp_server_is_asked_only_what_it_can_do() -> None:
    asked = []

    def options(heard: bytes) -> bytes:
        asked.append(heard)
        return b"RTSP/1.0 401 Unauthorized\r\nCSeq: 1\r\n\r\n" if b"\r\n\r\n" in heard else b""

    with tcp_server(options) as port:
        (found,) = rtsp_streams(HERE, [port], NOBODY)
    assert asked[-1].startswith(f"OPTIONS rtsp://{HOST}:{port}/ RTSP/1.0\r\nCSeq: 1\r\n".encode())
    assert camera(found).url == f"rtsp://{HOST}:{port}/"
    assert "put the path" in found.detail


def test_a_server_of_another_protocol_is_no_camera() -> None:
    with tcp_server(lambda heard: b"", greeting=b"SSH-2.0-OpenSSH_9.2\r\n") as port:
        assert rtsp_streams(HERE, [port], port) == []


# --- RTP ------------------------------------------------------------------------------------------

H264 = [bytes([kind]) + b"\x9a" * 20 for kind in (0x67, 0x68, 0x7C, 0x7C, 0x41, 0x65)]
H265 = [bytes([kind << 1, 1]) + b"\x9a" * 20 for kind in (32, 33, 34, 49, 49, 1)]


@pytest.mark.parametrize(
    ("packets", "codec"),
    [
        (rtp(H264), "H.264"),
        (rtp(H264, extended=True), "H.264"),
        (rtp(H265), "H.265"),
        ([b"\x47" + bytes(187)], "MPEG-TS"),
    ],
)
def test_video_that_arrives_is_found_with_its_codec(packets: list[bytes], codec: str) -> None:
    port = free_port()
    with udp_sender(port, packets):
        (found,) = rtp_streams(HERE, [port])
    assert (found.detail, found.name) == (codec, f"video from {HOST}")
    assert found.config["url"] == f"udp://0.0.0.0:{port}"
    if codec != "H.265":
        camera(found)


@pytest.mark.parametrize("packets", [[b"hello"], rtp([b""]), rtp(H264, payload_type=0), [b""]])
def test_what_is_no_video_is_not_listed(
    packets: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(conversation, "LISTEN_S", 0.3)
    port = free_port()
    with udp_sender(port, packets):
        assert rtp_streams(HERE, [port]) == []


def test_a_port_of_another_program_keeps_its_packets() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground_station:
        ground_station.bind(("0.0.0.0", 0))
        port = ground_station.getsockname()[1]
        with udp_sender(port, rtp(H264)):
            (found,) = rtp_streams(HERE, [port])
            ground_station.settimeout(20.0)
            assert rtp_payload(ground_station.recv(4096)) in H264
    assert "another program listens" in found.detail
    assert found.config == {}


# --- ONVIF ----------------------------------------------------------------------------------------


def onvif_answer(probe: bytes) -> bytes:
    assert b"NetworkVideoTransmitter" in probe
    assert b"discovery/Probe<" in probe
    return (
        b"<SOAP-ENV:Envelope><wsdd:ProbeMatches><wsdd:ProbeMatch>"
        b"<wsdd:Scopes>onvif://www.onvif.org/type/video_encoder "
        b"onvif://www.onvif.org/hardware/DWE-IP</wsdd:Scopes>"
        b"<wsdd:XAddrs>http://192.168.2.10:8000/onvif/device_service http://[fe80::1]/x"
        b"</wsdd:XAddrs></wsdd:ProbeMatch>"
    )


def test_an_onvif_camera_answers_the_probe() -> None:
    with udp_answerer(onvif_answer) as port:
        (found,) = onvif_cameras(HERE, (HOST, port))
    assert found.name == "ONVIF camera DWE-IP at 192.168.2.10"
    assert found.id == "http://192.168.2.10:8000/onvif/device_service"
    assert camera(found).url == "rtsp://192.168.2.10:554/"


@pytest.mark.parametrize("odd", [b"\xff\xfe", b"<XAddrs></XAddrs>", b"<XAddrs> http://[ </XAddrs>"])
def test_odd_answers_to_the_probe_cost_nothing(odd: bytes) -> None:
    with udp_answerer(lambda probe: odd) as port:
        assert all(camera(found) for found in onvif_cameras(HERE, (HOST, port)))


# --- MAVLink --------------------------------------------------------------------------------------


def swimming(wire: UdpWire | TcpWire) -> SimulatedDevice[bytes]:
    return SimulatedDevice(ArduSub(), wire, []).start()


def test_an_autopilot_is_heard_where_the_vehicle_sends_to() -> None:
    pytest.importorskip("pymavlink", reason="pymavlink is not installed")
    port = free_port()
    autopilot = swimming(UdpWire((HOST, port)))
    try:
        (found,) = mavlink_links(HERE, [port], [], NOBODY)
    finally:
        autopilot.close()
    assert found.name == f"submarine from {HOST}"
    assert found.detail == "heartbeats of system 1, component 1"
    assert found.config == {"kind": "mavlink", "link": {"kind": "udp", "port": port}}
    device(found)


def test_an_autopilot_is_heard_at_a_tcp_server() -> None:
    pytest.importorskip("pymavlink", reason="pymavlink is not installed")
    wire = TcpWire()
    port, autopilot = wire.port, swimming(wire)
    try:
        (found,) = mavlink_links(HERE, [], [port], NOBODY)
    finally:
        autopilot.close()
    assert found.config["link"] == {"kind": "tcp", "host": HOST, "port": port}
    device(found)


def heartbeat(system: int, autopilot: int) -> bytes:
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    wire = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
    return bytes(dialect.MAVLink_heartbeat_message(12, autopilot, 0, 0, 4, 3).pack(wire))


def test_another_vehicles_number_is_among_the_lines_to_paste() -> None:
    pytest.importorskip("pymavlink", reason="pymavlink is not installed")
    port = free_port()
    with udp_sender(port, [heartbeat(7, 3), heartbeat(255, 8), b"noise"]):
        (found,) = mavlink_links(HERE, [port], [], NOBODY)
    assert (found.config["system_id"], found.config["component_id"]) == (7, 1)


def test_a_ground_station_is_no_vehicle(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pymavlink", reason="pymavlink is not installed")
    monkeypatch.setattr(conversation, "LISTEN_S", 0.3)
    port = free_port()
    with udp_sender(port, [heartbeat(255, 8)]):
        assert mavlink_links(HERE, [port], [], NOBODY) == []


@pytest.mark.parametrize("version", ["/v1/mavlink", "/mavlink"])
def test_mavlink2rest_is_found_by_the_heartbeat_that_it_keeps(version: str) -> None:
    pytest.importorskip("pymavlink", reason="pymavlink is not installed")
    kept = {"message": {"type": "HEARTBEAT", "mavtype": {"type": "MAV_TYPE_SUBMARINE"}}}
    path = f"{version}/vehicles/1/components/1/messages/HEARTBEAT"
    with tcp_server(http({path: kept})) as port:
        (found,) = mavlink_links(HERE, [], [], port)
    assert found.name == f"submarine by mavlink2rest at {HOST}"
    link = {"kind": "mavlink2rest", "url": f"ws://{HOST}:{port}"}
    assert found.config == {"kind": "mavlink", "link": link}
    device(found)


def test_without_its_library_mavlink_is_not_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20.ardupilotmega", None)
    with pytest.raises(InputError, match="pip install 'aquaflow"):
        mavlink_links(HERE, [], [], NOBODY)


# --- DVLs -----------------------------------------------------------------------------------------


def test_a_dvl_is_heard_by_its_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aquaflow.drivers.network_discovery.waterlinked.USUAL_HOSTS", ())
    wire, enough = TcpWire(), threading.Event()
    port = wire.port
    dvl = SimulatedDevice(WaterLinkedJson(), wire, endless(motion(), enough)).start()
    try:
        (found,) = waterlinked_dvls(HERE, port, (HOST, NOBODY))
    finally:
        enough.set()
        dvl.close()
    assert found.name == f"Water Linked DVL at {HOST}"
    link = {"kind": "tcp", "host": HOST, "port": port}
    assert found.config == {"kind": "waterlinked_json", "link": link}
    device(found)


def test_a_dvl_whose_address_nobody_knows_is_found_by_its_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It answers with its fallback address, whatever its own is: where the answer comes from
    counts."""
    monkeypatch.setattr("aquaflow.drivers.network_discovery.waterlinked.USUAL_HOSTS", ())

    def named(question: bytes) -> bytes:
        header = b"\x00\x00\x84\x00" + bytes(2) + b"\x00\x01" + bytes(4)
        return (
            header + NAME + b"\x00\x01\x80\x01\x00\x00\x00\x78\x00\x04" + bytes([192, 168, 194, 95])
        )

    greeting = b'{"type":"velocity","vx":0.1}\r\n'
    with udp_answerer(named) as mdns, tcp_server(lambda heard: b"", greeting) as port:
        (found,) = waterlinked_dvls(["203.0.113.1.invalid"], port, (HOST, mdns))
    assert found.config["link"]["host"] == HOST


@pytest.mark.parametrize("greeting", [b"{}\r\n", b'{"type": "menu"}\n', b"\xff\xff\n", b"[" * 9999])
def test_other_servers_on_its_port_are_no_dvl(
    greeting: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("aquaflow.drivers.network_discovery.waterlinked.USUAL_HOSTS", ())
    monkeypatch.setattr(conversation, "LISTEN_S", 0.3)
    with tcp_server(lambda heard: b"", greeting) as port:
        assert waterlinked_dvls(HERE, port, (HOST, NOBODY)) == []


# --- all of them ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "look",
    [blueos_streams, mavlink_links, onvif_cameras, rtp_streams, rtsp_streams, waterlinked_dvls],
)
def test_without_hosts_the_network_is_left_alone(
    look: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    def opened(*_: object, **__: object) -> None:
        raise AssertionError("a socket was opened")

    monkeypatch.setattr(socket, "socket", opened)
    monkeypatch.setattr(socket, "create_connection", opened)
    assert look([]) == []  # type: ignore[operator]


@pytest.mark.parametrize("host", ["", "no such host", "a" * 300, "\u00fc\u0000", "[::1", "-"])
def test_what_is_no_host_is_nowhere(host: str, tmp_path: Path) -> None:
    assert conversation.ask_server((host, NOBODY)) == b""
    assert conversation.json_of((host, NOBODY), "/streams") is None


def test_a_server_that_never_ends_is_not_listened_to_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(conversation, "MOST_BYTES", 1000)
    with tcp_server(lambda heard: b"", greeting=b"x" * 1_000_000) as port:
        heard = conversation.ask_server((HOST, port), enough=lambda data: False)
    assert 1000 <= len(heard) <= 1000 + conversation.DATAGRAM
