"""Who gets to the viewer's server, and that one who hangs keeps nobody out."""

from __future__ import annotations

import http.client
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from aquaflow.config.viewer import ViewerConfig
from aquaflow.errors import ConfigError, InputError
from aquaflow.viewer.auth_proxy import LONGEST_HEAD, AuthProxy

TOKEN = "correct-horse-battery"


class Inside(BaseHTTPRequestHandler):
    """A server that trusts everybody."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Length", "6")
        self.end_headers()
        self.wfile.write(b"inside")

    def log_message(self, format: str, *args: object) -> None: ...


@pytest.fixture(scope="module")
def inside() -> Iterator[int]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), Inside)
    server.handle_error = lambda *_: None  # type: ignore[method-assign]
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield int(server.server_address[1])
    server.shutdown()
    server.server_close()


@pytest.fixture
def proxy(inside: int) -> Iterator[AuthProxy]:
    proxy = AuthProxy(ViewerConfig(port=0), inside)
    yield proxy
    proxy.close()


@pytest.fixture
def locked(inside: int, tmp_path: Path) -> Iterator[AuthProxy]:
    file = tmp_path / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    proxy = AuthProxy(ViewerConfig(port=0, token_file=file), inside)
    yield proxy
    proxy.close()


def get(proxy: AuthProxy, target: str, **headers: str) -> tuple[int, bytes, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", proxy.port, timeout=20)
    connection.request("GET", target, headers=headers)
    answer = connection.getresponse()
    found = answer.status, answer.read(), dict(answer.getheaders())
    connection.close()
    return found


def test_on_this_machine_everybody_may_look(proxy: AuthProxy) -> None:
    assert get(proxy, "/")[:2] == (200, b"inside")


def test_a_page_of_elsewhere_may_not(proxy: AuthProxy) -> None:
    assert get(proxy, "/", Host="evil.example")[0] == 403


def test_the_token_goes_into_a_cookie_and_out_of_the_address(locked: AuthProxy) -> None:
    assert get(locked, "/")[0] == 403
    status, _, headers = get(locked, f"/?token={TOKEN}")
    assert (status, headers["Location"]) == (303, "/")
    cookie = headers["Set-Cookie"].partition(";")[0]
    assert get(locked, "/", Cookie=cookie)[:2] == (200, b"inside")
    assert get(locked, "/", Cookie=cookie + "x")[0] == 403


def test_nobody_is_sent_to_another_server(locked: AuthProxy) -> None:
    _, _, headers = get(locked, f"//evil.example/?token={TOKEN}")
    assert headers["Location"] == "/"


def test_one_who_sends_no_end_of_a_request_is_let_go_and_keeps_nobody_out(proxy: AuthProxy) -> None:
    with socket.create_connection(("127.0.0.1", proxy.port), timeout=20) as flood:
        flood.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 100)
        assert get(proxy, "/")[0] == 200
        flood.sendall(b"x" * LONGEST_HEAD)
        assert get(proxy, "/")[0] == 200


def test_an_address_beyond_loopback_needs_a_token() -> None:
    with pytest.raises(ValueError, match="token_file"):
        ViewerConfig(enabled=True, host="0.0.0.0", port=0)


def test_a_taken_address_is_one_sentence(proxy: AuthProxy, inside: int) -> None:
    with pytest.raises(InputError, match=r"viewer\.port"):
        AuthProxy(ViewerConfig(port=proxy.port), inside)


def test_a_token_that_others_may_read_lets_nobody_in(inside: int, tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text(TOKEN)
    file.chmod(0o644)
    with pytest.raises(ConfigError):
        AuthProxy(ViewerConfig(port=0, token_file=file), inside)
