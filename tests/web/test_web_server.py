"""Attacks over raw sockets on the server under page, viewer and Foxglove's socket."""

from __future__ import annotations

import http.client
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from aquaflow.config.service import ListenConfig
from aquaflow.web import HttpRequest, HttpResponse, WebServer
from aquaflow.web import server as connection
from aquaflow.web.access import Access
from tests.small_recording import GIVE_UP_S

TOKEN = "correct-horse-battery"
SHORT_S = 0.5
"""In place of ten seconds."""
LARGE = bytes(20_000_000)
"""More than the kernel's buffers of a connection hold."""


class Told:
    """A server, and what it was asked."""

    def __init__(self, config: ListenConfig) -> None:
        self.asked: list[tuple[str, str, bytes | None]] = []
        self.server = WebServer(config, Access(config), self.answer, "test", most_bytes=100)

    def answer(self, request: HttpRequest) -> HttpResponse:
        self.asked.append((request.method, request.target, request.body))
        return HttpResponse(200, "text/plain", LARGE if request.target == "/large" else b"yes\n")


@pytest.fixture
def told() -> Iterator[Told]:
    told = Told(ListenConfig(port=1).model_copy(update={"port": 0}))
    yield told
    told.server.close()


@pytest.fixture
def quick(told: Told, monkeypatch: pytest.MonkeyPatch) -> Told:
    """With little patience."""
    monkeypatch.setattr(connection, "REQUEST_S", SHORT_S)
    monkeypatch.setattr(connection, "ANSWER_S", SHORT_S)
    monkeypatch.setattr(connection, "SLOWEST_BYTES_S", 1e9)
    return told


@pytest.fixture
def nobody_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loopback's addresses stand for the network's."""
    monkeypatch.setattr(connection, "is_loopback", lambda peer: peer == "127.0.0.1")


def connected(told: Told, source: str = "127.0.0.1") -> socket.socket:
    address = ("127.0.0.1", told.server.port)
    return socket.create_connection(address, GIVE_UP_S, source_address=(source, 0))


def said(told: Told, raw: bytes) -> bytes:
    """Everything that comes back until the server closes."""
    with connected(told) as client:
        with suppress(OSError):  # the server may have closed before it was all said
            client.sendall(raw)
            client.shutdown(socket.SHUT_WR)
        return everything(client)


def everything(client: socket.socket) -> bytes:
    heard = b""
    with suppress(ConnectionError):
        while part := client.recv(1 << 16):
            heard += part
    return heard


def ordinary(told: Told, source: str = "127.0.0.1", **headers: str) -> bool:
    asking = http.client.HTTPConnection(
        "127.0.0.1", told.server.port, timeout=GIVE_UP_S, source_address=(source, 0)
    )
    try:
        asking.request("GET", "/", headers=headers)
        return asking.getresponse().read() == b"yes\n"
    except (OSError, http.client.HTTPException):
        return False
    finally:
        asking.close()


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + GIVE_UP_S
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def test_a_body_is_never_the_next_request(told: Told) -> None:
    inner = b"POST /inner HTTP/1.1\r\nHost: localhost\r\n\r\n"
    head = b"GET /outer HTTP/1.1\r\nHost: localhost\r\n"
    said(told, head + b"Content-Length: %d\r\n\r\n" % len(inner) + inner)
    chunk = b"%x\r\n%s\r\n0\r\n\r\n" % (len(inner), inner)
    said(told, head + b"Transfer-Encoding: chunked\r\n\r\n" + chunk)
    assert told.asked == [("GET", "/outer", inner)] * 2


def test_a_body_that_is_too_long_is_not_read_and_ends_the_connection(told: Told) -> None:
    post = b"POST /x HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9000\r\n\r\n"
    heard = said(told, post + b"GET /inner HTTP/1.1\r\nHost: localhost\r\n\r\n" * 200)
    assert heard.count(b"HTTP/1.1") == 1
    assert told.asked == [("POST", "/x", None)]


@pytest.mark.parametrize(
    "raw",
    [
        b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n",
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET http://evil.example/ HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 3\r\nTransfer-Encoding: chunked\r\n\r\n"
        b"0\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 3\r\nContent-Length: 4\r\n\r\nabcd",
        b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: -1\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: gzip\r\n\r\nabc",
        b"GET / HTTP/1.1\r\nHost: a\r\nX: " + b"x" * 400_000 + b"\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost : a\r\n\r\n",
        b"GET /\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + b"\x00" * 50 + b"\r\n\r\n",
    ],
    ids=[
        "two hosts", "no host", "another server", "two framings", "two lengths", "negative length",
        "unknown coding", "long head", "space before colon", "no version", "TLS",
    ],
)  # fmt: skip
def test_what_is_no_plain_request_is_refused_and_asks_nothing(told: Told, raw: bytes) -> None:
    status = said(told, raw).partition(b" ")[2][:3]
    assert status in (b"400", b"431", b"501", b""), status
    assert told.asked == []
    assert ordinary(told)


def test_requests_in_one_piece_are_answered_in_order(told: Told) -> None:
    ask = b"GET /%d HTTP/1.1\r\nHost: localhost\r\n\r\n"
    heard = said(told, b"".join(ask % number for number in range(300)))
    assert heard.count(b"yes\n") == 300
    assert [target for _, target, _ in told.asked] == [f"/{number}" for number in range(300)]


def test_a_head_request_has_the_head_of_a_get_alone(told: Told) -> None:
    heard = said(told, b"HEAD / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
    assert b"200" in heard
    assert b"content-length: 4" in heard.lower()
    assert heard.endswith(b"\r\n\r\n")
    assert b" 405 " in said(told, b"PUT / HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n")


@pytest.mark.parametrize(
    ("start", "drip"),
    [
        (b"", b""),
        (b"GET / HTTP/1.1\r\n", b"X: y\r\n"),
        (b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 90\r\n\r\n", b"x"),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\nGET", b"T"),
    ],
    ids=["nothing", "head", "body", "second request"],
)
def test_a_request_that_takes_too_long_is_cut_off(quick: Told, start: bytes, drip: bytes) -> None:
    with connected(quick) as client:
        client.settimeout(SHORT_S / 5)
        client.sendall(start)
        end = time.monotonic() + GIVE_UP_S
        while time.monotonic() < end:
            with suppress(TimeoutError):
                try:
                    client.sendall(drip)
                    if not client.recv(1 << 16):
                        return
                except ConnectionError:
                    return
    pytest.fail("it was let hang")


def test_a_client_that_does_not_take_its_answer_is_cut_off(quick: Told) -> None:
    with connected(quick) as client:
        client.sendall(b"GET /large HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        until(lambda: bool(quick.asked))
        time.sleep(4 * SHORT_S)  # what the attack does: nothing
        assert len(everything(client)) < len(LARGE)
    assert ordinary(quick)


def attack(told: Told, source: str, going: threading.Event, count: int = 64) -> None:
    """Slow sockets, each made anew when it is closed."""
    slow: list[socket.socket] = []
    while going.is_set():
        while len(slow) < count:
            client = connected(told, source)
            client.setblocking(False)
            slow.append(client)
        for client in list(slow):
            try:
                client.send(
                    b"GET / HTTP/1.1\r\nHost: localhost\r\n" if client.gettimeout() else b"X"
                )
                with suppress(BlockingIOError):
                    if not client.recv(100):
                        raise ConnectionError
            except OSError:
                client.close()
                slow.remove(client)
        time.sleep(SHORT_S / 10)
    for client in slow:
        client.close()


@pytest.mark.parametrize("shared", [False, True], ids=["own address", "the attacker's address"])
@pytest.mark.parametrize("source", ["127.0.0.2", "127.0.0.1"], ids=["network", "loopback"])
def test_64_slow_sockets_keep_no_ordinary_request_out(
    told: Told, nobody_is_known: None, source: str, shared: bool
) -> None:
    going = threading.Event()
    going.set()
    attacker = threading.Thread(target=attack, args=(told, source, going))
    attacker.start()
    try:
        time.sleep(SHORT_S)
        other = source if shared else "127.0.0.3"
        assert [ordinary(told, other) for _ in range(24)] == [True] * 24
    finally:
        going.clear()
        attacker.join()


def test_one_address_holds_sixteen_connections_and_a_new_one_displaces_the_oldest(
    told: Told, nobody_is_known: None
) -> None:
    with ExitStack() as open_:
        held = [open_.enter_context(connected(told, "127.0.0.2")) for _ in range(16)]
        others = [open_.enter_context(connected(told, "127.0.0.3")) for _ in range(3)]
        newcomer = open_.enter_context(connected(told, "127.0.0.2"))
        assert ordinary(told, "127.0.0.2")
        assert everything(held[0]) == b""
        for client in (*held[1:], *others, newcomer):
            client.settimeout(0.01)
            with pytest.raises(TimeoutError):
                client.recv(1)


def test_many_addresses_take_no_room_from_loopback_nor_from_those_with_the_token(
    tmp_path: Path, nobody_is_known: None
) -> None:
    file = tmp_path / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    told = Told(ListenConfig(port=1, token_file=file).model_copy(update={"port": 0}))
    with ExitStack() as open_:
        on_board = open_.enter_context(connected(told))
        holder = http.client.HTTPConnection(
            "127.0.0.1", told.server.port, timeout=GIVE_UP_S, source_address=("127.0.0.9", 0)
        )
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        holder.request("GET", "/", headers=bearer)
        assert holder.getresponse().read() == b"yes\n"
        kept = holder.sock
        for number in range(96):
            open_.enter_context(connected(told, f"127.0.1.{number // 4 + 1}"))
        holder.request("GET", "/", headers=bearer)
        assert holder.getresponse().read() == b"yes\n"
        assert holder.sock is kept
        on_board.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        assert b"yes" in everything(on_board)
        holder.close()
    told.server.close()


@pytest.mark.parametrize(
    ("peer", "group"),
    [
        ("192.168.2.1", "192.168.2.1"),
        ("::ffff:192.168.2.1", "192.168.2.1"),
        ("2001:db8::1", "2001:db8::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("", ""),
    ],
)
def test_a_host_with_many_addresses_counts_once(peer: str, group: str) -> None:
    assert connection.group_of(peer) == group


def test_a_server_that_is_closed_lets_go_of_hanging_clients_and_of_its_port(told: Told) -> None:
    with connected(told) as client:
        client.sendall(b"GET /large HTTP/1.1\r\nHost: localhost\r\n\r\nGET / HT")
        until(lambda: bool(told.asked))
        told.server.close()
        with pytest.raises(ConnectionError):
            connected(told)
        assert len(everything(client)) < len(LARGE)


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost"])
def test_it_listens_where_it_is_told_to(host: str) -> None:
    told = Told(ListenConfig(host=host, port=1).model_copy(update={"port": 0}))
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as client:
        client.settimeout(GIVE_UP_S)
        client.connect((host, told.server.port))
        client.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        assert b"yes" in everything(client)
    told.server.close()
