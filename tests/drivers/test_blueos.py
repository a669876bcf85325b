"""BlueOS's camera manager, simulated: which streams arrive here, and what to do for others."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from aquaflow.config.cameras import StreamConfig
from aquaflow.drivers.network_discovery import blueos
from aquaflow.drivers.network_discovery.blueos import FREE_PORT, blueos_streams

Serve = Callable[[object], tuple[list[str], int]]


def stream(*endpoints: str, name: str = "UDP Stream 0") -> dict[str, Any]:
    """As the manager describes one (its api/src/v1/stream.rs)."""
    picture = {
        "type": "video", "encode": "H264", "height": 1080, "width": 1920,
        "frame_interval": {"numerator": 1, "denominator": 30},
    }  # fmt: skip
    source = {"Local": {"name": "H264 USB Camera", "device_path": "/dev/video2", "type": "Usb"}}
    information = {"endpoints": list(endpoints), "configuration": picture}
    return {
        "id": "00000000-0000-0000-0000-000000000000", "running": True, "error": None,
        "mavlink": {"system_id": 1, "component_id": 100},
        "video_and_stream": {
            "name": name, "video_source": source,
            "stream_information": {**information, "extended_configuration": None},
        },
    }  # fmt: skip


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Start a manager that answers with this; its hosts and its port."""
    servers: list[ThreadingHTTPServer] = []

    def start(streams: object) -> tuple[list[str], int]:
        class Manager(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                known = self.path == "/streams"
                body = streams if isinstance(streams, bytes) else json.dumps(streams).encode()
                self.send_response(200 if known else 404)
                self.end_headers()
                self.wfile.write(body if known else b"")

            def log_message(self, format: str, *args: object) -> None: ...

        server = ThreadingHTTPServer(("127.0.0.1", 0), Manager)
        servers.append(server)
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        return ["127.0.0.1"], int(server.server_address[1])

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def test_a_stream_to_the_surface_alone_comes_with_the_endpoint_to_add(serve: Serve) -> None:
    [found] = blueos_streams(*serve([stream("udp://192.168.2.1:5600")]))
    assert found.name == "BlueOS: UDP Stream 0"
    assert "H264, 1920 x 1080 to udp://192.168.2.1:5600" in found.detail
    assert f"add the endpoint udp://127.0.0.1:{FREE_PORT}" in found.detail
    assert found.config["url"] == f"udp://0.0.0.0:{FREE_PORT}"
    StreamConfig.model_validate(found.config)


def test_a_stream_that_comes_here_too_is_read_at_its_port(serve: Serve) -> None:
    both = stream("udp://192.168.2.1:5600", "udp://127.0.0.1:5777")
    [found] = blueos_streams(*serve([both]))
    assert found.config == {"kind": "stream", "url": "udp://0.0.0.0:5777"}
    assert "add the endpoint" not in found.detail


def test_a_stream_by_rtsp_has_its_whole_address(serve: Serve) -> None:
    served = stream("rtspt://0.0.0.0:8554/video_stream__dev_video2", name="RTSP Stream 0")
    redirected = stream("rtsp://10.0.0.9/live", name="b") | {"running": False}
    redirected["video_and_stream"]["stream_information"]["configuration"] = {"type": "redirect"}
    [front, other] = blueos_streams(*serve([served, stream(), redirected]))
    assert front.config["url"] == "rtsp://127.0.0.1:8554/video_stream__dev_video2"
    assert (front.name, front.detail) == ("BlueOS: RTSP Stream 0", "H264, 1920 x 1080")
    assert (other.id, other.detail) == ("rtsp://127.0.0.1:554/live", "video, not running")
    for found in (front, other):
        StreamConfig.model_validate(found.config)


def test_of_several_endpoints_those_by_rtsp_are_taken(serve: Serve) -> None:
    [found] = blueos_streams(*serve([stream("udp://10.0.0.1:5600", "rtsp://10.0.0.2:8554/video")]))
    assert found.id == "rtsp://127.0.0.1:8554/video"


def test_a_manager_at_two_addresses_lists_a_stream_by_udp_once(serve: Serve) -> None:
    hosts, port = serve([stream("udp://192.168.2.1:5600")])
    assert len(blueos_streams([*hosts, "localhost"], port)) == 1


@pytest.mark.parametrize(("own", "here"), [("192.168.2.7", True), ("192.168.2.1", False)])
def test_on_another_computer_its_own_address_is_the_one_to_add(
    serve: Serve, own: str, here: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(blueos, "_own_address", lambda host: own)
    [found] = blueos_streams(*serve([stream("udp://192.168.2.7:5600", "udp://127.0.0.1:5777")]))
    assert (f"add the endpoint udp://{own}:{FREE_PORT}" in found.detail) is not here
    port = 5600 if here else FREE_PORT
    assert found.config["url"] == f"udp://0.0.0.0:{port}"


@pytest.mark.parametrize(
    "said",
    [
        b"not json", b"[" * 100_000, {}, [None], [{}], [{"video_and_stream": 3}],
        [stream("udp://[")], [stream("udp://127.0.0.1:99999")], [stream()],
    ],
    ids=str,
)  # fmt: skip
def test_what_is_no_list_of_streams_is_none(serve: Serve, said: object) -> None:
    assert blueos_streams(*serve(said)) == []


def test_without_blueos_there_is_nothing() -> None:
    assert blueos_streams(["127.0.0.1"], 1) == []
