"""Whose pages and programs get to Foxglove's socket."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from aquaflow.config.service import FoxgloveConfig
from aquaflow.live.foxglove.server import MOST_CLIENTS, PROTOCOLS, FoxgloveServer
from tests.browser import Browser, needs_browser

TOKEN = "correct-horse-battery"
EVIL = "http://evil.example"
APP = "https://app.foxglove.dev"
PAGE = """<script>
window.said = "nothing";
const socket = new WebSocket("ws://127.0.0.1:PORT/QUERY", ["foxglove.sdk.v1"]);
socket.onmessage = () => { window.said = "data"; };
socket.onerror = () => { if (window.said === "nothing") window.said = "refused"; };
</script>"""


@pytest.fixture
def server() -> Iterator[FoxgloveServer]:
    server = FoxgloveServer(FoxgloveConfig(enabled=True, port=0), "test")
    yield server
    server.close()


@pytest.fixture
def locked(tmp_path: Path) -> Iterator[FoxgloveServer]:
    file = tmp_path / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    config = FoxgloveConfig(enabled=True, host="0.0.0.0", port=0, token_file=file)
    server = FoxgloveServer(config, "test")
    yield server
    server.close()


def status(server: FoxgloveServer, target: str = "/", **headers: str) -> int:
    """101: the socket was opened, and the server's greeting came."""
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    address = f"ws://127.0.0.1:{server.port}{target}"
    try:
        with connect(address, subprotocols=[PROTOCOLS[0]], additional_headers=named) as socket:
            assert "serverInfo" in str(socket.recv(20))
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


@pytest.mark.parametrize("origin", [EVIL, "null", "file://", "http://127.0.0.1:1", f"{APP}.evil"])
def test_a_page_of_elsewhere_gets_nothing(server: FoxgloveServer, origin: str) -> None:
    assert status(server, Origin=origin) == 403
    assert status(server, Origin=origin, Sec_Fetch_Site="none") == 403


def test_programs_foxgloves_own_page_and_those_of_the_config_get_in(server: FoxgloveServer) -> None:
    assert status(server) == 101
    assert status(server, Origin=APP) == 101
    config = FoxgloveConfig(enabled=True, port=0, origins=["file://"])
    desktop = FoxgloveServer(config, "test")
    assert status(desktop, Origin="file://") == 101
    assert status(desktop, Origin=APP) == 403
    desktop.close()


def test_beyond_loopback_the_token_is_asked_for_and_a_page_that_was_told_it_gets_in(
    locked: FoxgloveServer,
) -> None:
    bearer, cookie = {"Authorization": f"Bearer {TOKEN}"}, {"Cookie": f"aquaflow_token={TOKEN}"}
    assert status(locked) == 403
    assert status(locked, Origin=APP) == 403
    assert status(locked, "/?token=wrong") == 403
    assert status(locked, f"/?token={TOKEN}") == 101
    assert status(locked, f"/?token={TOKEN}", Origin="file://") == 101
    assert status(locked, **bearer) == 101
    assert status(locked, **cookie) == 101
    assert status(locked, **cookie, Origin=EVIL) == 403  # a browser sends cookies for every page


def test_another_name_than_this_machines_is_refused(server: FoxgloveServer) -> None:
    """A page whose name was made to lead here (DNS rebinding) has its own name in Host."""

    aiohttp = pytest.importorskip("aiohttp")

    async def rebound() -> int:
        async with aiohttp.ClientSession() as session:
            address = f"ws://127.0.0.1:{server.port}/"
            headers = {"Host": "evil.example", "Origin": EVIL}
            try:
                await session.ws_connect(address, protocols=PROTOCOLS, headers=headers)
            except aiohttp.WSServerHandshakeError as refused:
                return refused.status
            return 101

    assert asyncio.run(rebound()) == 403


def test_another_librarys_client_is_served(server: FoxgloveServer) -> None:
    aiohttp = pytest.importorskip("aiohttp")

    async def greeted() -> list[str]:
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"ws://127.0.0.1:{server.port}/", protocols=PROTOCOLS) as socket,
        ):
            await socket.send_str("no json")
            await socket.send_str('{"op": "subscribe", "subscriptions": [{"id": -1}]}')
            await socket.send_bytes(b"\x00")
            return [(await socket.receive_json(timeout=20))["op"] for _ in range(2)]

    assert asyncio.run(greeted()) == ["serverInfo", "advertise"]


def test_clients_are_bounded_and_their_room_is_given_back(server: FoxgloveServer) -> None:
    address = f"ws://127.0.0.1:{server.port}"
    sockets = [connect(address, subprotocols=[PROTOCOLS[0]]) for _ in range(MOST_CLIENTS)]
    for socket in sockets:
        socket.recv(20)
    assert status(server) == 403
    for socket in sockets:
        socket.close()
    while server._clients:
        threading.Event().wait(0.01)
    assert status(server) == 101


@needs_browser
@pytest.mark.ci
@pytest.mark.timeout(120)
def test_a_browser_keeps_a_page_of_another_origin_from_reading_and_lets_one_with_the_token(
    server: FoxgloveServer, locked: FoxgloveServer, tmp_path: Path
) -> None:
    told = f"?token={TOKEN}"
    cases = {"open": (server, ""), "locked": (locked, ""), "told": (locked, told)}
    for name, (asked, query) in cases.items():
        page = PAGE.replace("PORT", str(asked.port)).replace("QUERY", query)
        (tmp_path / f"{name}.html").write_text(page)
    handler = partial(SimpleHTTPRequestHandler, directory=str(tmp_path))
    elsewhere = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=elsewhere.serve_forever, daemon=True).start()
    browser = Browser(tmp_path / "profile")
    try:
        for name, expected in (("open", "refused"), ("locked", "refused"), ("told", "data")):
            browser.open(f"http://127.0.0.1:{elsewhere.server_address[1]}/{name}.html")
            browser.wait("window.said !== 'nothing'")
            assert browser.run("return window.said") == expected, name
    finally:
        browser.close()
        elsewhere.shutdown()
