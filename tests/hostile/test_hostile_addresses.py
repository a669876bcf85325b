"""What comes over the network, and addresses that are none."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from aquaflow.base.errors.crash_report import FAILED, MISUSED
from aquaflow.config.service import ListenConfig
from aquaflow.live.health.http import HealthServer
from tests.command_line import Cli, refused


@pytest.mark.parametrize(
    "url",
    [
        "http://[::1",
        "http://[::1]:9",
        "http://" + "a" * 3000 + ":80",
        "http://" + "a" * 100 + ".de:80",
        "http://127.0.0.1:999999",
        "http://127.0.0.1:port",
        "http://a..b:80",
        "http://127.0.0.1:9/\nx",
        "ftp://127.0.0.1",
        "",
    ],
)
def test_an_address_where_no_service_can_be_is_refused(command: Cli, url: str) -> None:
    ran = command("run", "status", "--url", url)
    # No address, or one at which nothing answers.
    assert ran.code in {MISUSED, FAILED}
    refused(ran, code=ran.code)
    assert len(ran.err) < 300


@pytest.fixture
def answering() -> Iterator[Callable[[bytes], str]]:
    """The address of a server that answers everything with the bytes it is given."""
    servers: list[HTTPServer] = []

    def start(body: bytes) -> str:
        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format: str, *args: object) -> None:
                """Nothing."""

        servers.append(HTTPServer(("127.0.0.1", 0), Handler))
        threading.Thread(target=servers[-1].serve_forever, daemon=True).start()
        return f"http://127.0.0.1:{servers[-1].server_address[1]}"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize(
    "report",
    [
        "[" * 100_000,
        "[]",
        json.dumps({"state": 1, "reason": 2}),
        json.dumps({"state": "ok", "reason": "", "changes": [1]}),
        json.dumps({"state": "ok", "reason": "", "changes": [{"ago_s": "x"}]}),
        json.dumps({"state": "ok", "reason": ""}) + " " * (2 << 20) + "x",
    ],
    ids=["deep", "list", "numbers", "changes", "change", "long"],
)
def test_an_answer_that_is_no_report_is_refused(
    command: Cli, answering: Callable[[bytes], str], report: str
) -> None:
    if report.endswith("x"):
        ran = command("run", "status", "--url", answering(report.encode()))
        assert "Traceback" not in ran.err
    else:
        refused(
            command("run", "status", "--url", answering(report.encode())), "no AquaFlow service"
        )


@pytest.mark.parametrize(
    "target", ["//[", "http://[::1/health", "//[x]/?token=a", "/health?token=%ff", "*", "//"]
)
def test_a_malformed_target_gets_an_answer_and_the_server_goes_on(target: str) -> None:
    server = HealthServer(
        ListenConfig.model_construct(host="127.0.0.1", port=0, token_file=None),
        lambda: {"state": "mapping"},
    )
    try:
        for asked in (target, "/health"):
            with socket.create_connection(("127.0.0.1", server.port), 5.0) as client:
                head = f"GET {asked} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
                client.sendall(head.encode())
                status = int(client.recv(4096).split()[1])
        assert status == 200
    finally:
        server.close()
