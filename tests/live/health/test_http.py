"""What the service tells, whom it tells, and that a client who hangs costs nothing."""

from __future__ import annotations

import errno
import http.client
import json
import logging
import re
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from aquaflow.base.errors import ConfigError
from aquaflow.config.service import ListenConfig, ServiceConfig
from aquaflow.config.stage import validate
from aquaflow.live.health.http import HealthServer
from aquaflow.web.access import Access, read_token
from tests.command_line import Cli
from tests.live.health.reports import REPORT

TOKEN = "correct-horse-battery"


@pytest.fixture
def server() -> Iterator[HealthServer]:
    config = ListenConfig.model_construct(host="127.0.0.1", port=0, token_file=None)
    server = HealthServer(config, lambda: REPORT)
    yield server
    server.close()


@pytest.fixture
def token_file(tmp_path: Path) -> Path:
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n")
    file.chmod(0o600)
    return file


@pytest.fixture
def locked(token_file: Path) -> Iterator[HealthServer]:
    config = ListenConfig.model_construct(host="127.0.0.1", port=0, token_file=token_file)
    server = HealthServer(config, lambda: REPORT)
    yield server
    server.close()


def get(port: int, target: str, **headers: str) -> tuple[int, str, dict[str, str]]:
    return ask("GET", port, target, **headers)


def ask(
    method: str, port: int, target: str, body: str | None = None, **headers: str
) -> tuple[int, str, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request(method, target, body, headers)
    answer = connection.getresponse()
    body = answer.read().decode()
    connection.close()
    return answer.status, body, dict(answer.getheaders())


def test_health_is_json_and_metrics_are_prometheus(server: HealthServer) -> None:
    status, body, _ = get(server.port, "/health")
    assert (status, json.loads(body)) == (200, REPORT)
    status, body, headers = get(server.port, "/metrics")
    assert status == 200
    assert headers["Content-Type"].startswith("text/plain; version=0.0.4")
    assert 'aquaflow_state{state="tracking"} 1' in body


def test_the_page_and_blueos_are_served_and_nothing_else(server: HealthServer) -> None:
    assert "AquaFlow" in get(server.port, "/")[1]
    assert json.loads(get(server.port, "/register_service")[1])["name"] == "AquaFlow"
    for path in ("/etc/passwd", "/page/", "/page/__init__.py", "/page/../http.py", "/index.html"):
        assert get(server.port, path)[0] == 404, path


def test_the_page_s_files_have_their_types_and_load_nothing_from_elsewhere(
    server: HealthServer,
) -> None:
    _, html, headers = get(server.port, "/", Host="localhost:8230")
    assert "frame-ancestors 'self' http://localhost:*" in headers["Content-Security-Policy"]
    named = set(re.findall(r'(?:src|href)="(page/[^"]+)"', html))
    assert {"page/page.js", "page/style.css"} <= named
    kinds = {"js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}
    for name in named:
        status, text, headers = get(server.port, f"/{name}")
        assert status == 200
        assert headers["Content-Type"].startswith(kinds[name.rpartition(".")[2]])
        assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)[a-z]", text)


def test_the_path_is_told_where_there_is_one(server: HealthServer) -> None:
    assert get(server.port, "/path.json")[0] == 404
    config = ListenConfig.model_construct(host="127.0.0.1", port=0, token_file=None)
    mapping = HealthServer(config, lambda: REPORT, lambda: {"sub_maps": [], "now": None})
    assert json.loads(get(mapping.port, "/path.json")[1]) == {"sub_maps": [], "now": None}
    mapping.close()


def test_a_page_of_elsewhere_cannot_read_a_socket_of_this_machine(server: HealthServer) -> None:
    assert get(server.port, "/health", Host="evil.example")[0] == 403
    assert get(server.port, "/health", Host="[::1]:8230")[0] == 200


def test_a_token_is_asked_for_in_header_cookie_or_address(locked: HealthServer) -> None:
    assert get(locked.port, "/health")[0] == 403
    assert get(locked.port, "/path.json")[0] == 403
    assert get(locked.port, "/health", Authorization="Bearer wrong")[0] == 403
    assert get(locked.port, "/health", Authorization=f"Bearer {TOKEN}")[0] == 200
    status, _, headers = get(locked.port, f"/health?token={TOKEN}")
    assert status == 200
    cookie = headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert get(locked.port, "/health", Cookie=cookie.partition(";")[0])[0] == 200
    assert get(locked.port, "/health", Host="elsewhere", Cookie="aquaflow_token=x")[0] == 403


def test_the_page_comes_without_a_token_and_its_form_gives_the_cookie(
    locked: HealthServer,
) -> None:
    assert get(locked.port, "/")[0] == 200
    assert get(locked.port, "/page/page.js")[0] == 200
    for wrong in ("", "token=", "token=wrong", f"token={TOKEN}x", f"token={TOKEN}&token=wrong"):
        status, said, headers = ask("POST", locked.port, "/login", wrong)
        assert (status, "Set-Cookie" in headers) == (403, False)
        assert "not the token" in json.loads(said)["error"]
    status, _, headers = ask("POST", locked.port, "/login", f"token={TOKEN}%0A")
    assert status == 200
    assert {"HttpOnly", "SameSite=Strict"} <= set(headers["Set-Cookie"].split("; "))
    cookie = headers["Set-Cookie"].partition(";")[0]
    assert get(locked.port, "/health", Cookie=cookie)[0] == 200


def test_a_form_that_is_too_long_is_not_read_and_other_forms_are_nothing(
    locked: HealthServer,
) -> None:
    assert ask("POST", locked.port, "/login", f"token={TOKEN}&x={'x' * 5000}")[0] == 413
    assert ask("POST", locked.port, "/login", None, **{"Content-Length": "-1"})[0] == 400
    assert ask("POST", locked.port, "/health", f"token={TOKEN}")[0] == 404


def test_clients_that_hang_keep_nobody_else_out(server: HealthServer) -> None:
    hanging = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(5)]
    for client in hanging:
        client.sendall(b"GET /health HTTP/1.1\r\n")  # and never another byte
    assert get(server.port, "/health")[0] == 200
    for client in hanging:
        client.close()


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.2.2", "::", "vehicle.local"])
def test_no_socket_beyond_loopback_without_a_token(host: str) -> None:
    with pytest.raises(ConfigError, match="token_file"):
        validate(ServiceConfig, {"health": {"host": host, "port": 8230}}, "test")


def test_a_token_that_others_may_read_or_guess_is_refused(token_file: Path) -> None:
    assert read_token(token_file) == TOKEN
    token_file.chmod(0o644)
    with pytest.raises(ConfigError, match="chmod"):
        read_token(token_file)
    token_file.chmod(0o600)
    token_file.write_text("1234")
    with pytest.raises(ConfigError, match="shorter"):
        Access(ListenConfig(port=1, token_file=token_file))


def test_status_prints_the_report_and_its_exit_code_says_if_all_is_well(
    aquaflow: Cli, server: HealthServer
) -> None:
    url = f"http://127.0.0.1:{server.port}"
    asked = aquaflow("run", "status", "--url", url)
    assert asked.code == 0
    assert "tracking: every frame has a pose" in asked.out
    asked = aquaflow("run", "status", "--url", "http://127.0.0.1:1")
    assert asked.code == 1
    assert "no service answers" in asked.err


def test_a_request_that_fails_is_logged_and_the_next_is_answered(
    server: HealthServer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def failing(*_: object) -> None:
        raise OSError(errno.EIO, "planted")

    with monkeypatch.context() as broken, caplog.at_level(logging.ERROR):
        broken.setattr("aquaflow.live.health.http.path_of", failing)
        assert get(server.port, "/health")[0] == 500
    assert "a request could not be answered" in caplog.text
    assert get(server.port, "/health")[0] == 200
