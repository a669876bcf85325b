"""Who may ask for what over HTTP: tokens, pages of elsewhere, bodies."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from aquaflow.config.service import ListenConfig
from aquaflow.live.control import DivePhase, ServiceControl
from aquaflow.live.health.http import MOST_BYTES, HealthServer
from tests.live.health.reports import REPORT

TOKEN = "correct-horse-battery"
BEARER = {"Authorization": f"Bearer {TOKEN}"}
COOKIE = {"Cookie": f"aquaflow_token={TOKEN}"}


class Asked:
    """A server, and what it did."""

    def __init__(self, token_file: Path | None) -> None:
        config = ListenConfig.model_construct(host="127.0.0.1", port=0, token_file=token_file)
        self.control, self.jpeg = ServiceControl(), None
        report = {**REPORT, "dive": {"name": "dive-1"}}
        self.server = HealthServer(
            config, lambda: report, control=self.control, picture=lambda: self.jpeg
        )

    jpeg: bytes | None

    def send(
        self, method: str, target: str, body: bytes = b"", **headers: str
    ) -> tuple[int, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=20)
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, target, body=body, headers=named)
        answer = connection.getresponse()
        said = answer.read()
        connection.close()
        return answer.status, said

    def post(self, what: str, **headers: str) -> int:
        return self.send("POST", f"/dive/{what}", **headers)[0]


@pytest.fixture
def guarded(tmp_path: Path) -> Iterator[Asked]:
    token = tmp_path / "token"
    token.write_text(TOKEN)
    token.chmod(0o600)
    asked = Asked(token)
    yield asked
    asked.server.close()


@pytest.fixture
def on_board() -> Iterator[Asked]:
    """A socket of this machine alone, without a token."""
    asked = Asked(None)
    yield asked
    asked.server.close()


def test_a_request_is_accepted_or_refused_with_json(guarded: Asked) -> None:
    status, said = guarded.send("POST", "/dive/start", **BEARER)
    assert (status, json.loads(said)) == (202, {"state": "mapping", "dive": "dive-1"})
    status, said = guarded.send("POST", "/dive/start", **BEARER)
    assert status == 409
    assert list(json.loads(said)) == ["error"]


def test_without_a_token_in_header_or_cookie_nothing_changes(guarded: Asked) -> None:
    assert guarded.post("start") == 403
    assert guarded.post("start", Authorization="Bearer wrong") == 403
    assert guarded.post(f"start?token={TOKEN}") == 403  # an address may be a link
    assert guarded.control.phase is DivePhase.IDLE
    assert guarded.post("start", **COOKIE) == 202


def test_another_sites_page_changes_nothing_even_with_the_cookie(guarded: Asked) -> None:
    own = f"127.0.0.1:{guarded.server.port}"
    for foreign in (
        {"Origin": "http://evil.example"},
        {"Origin": "http://127.0.0.1:1"},  # another service of the same machine
        {"Origin": "null"},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
        {"Sec_Fetch_Site": "cross-site", "Origin": f"http://{own}"},
    ):
        assert guarded.post("start", **COOKIE, **foreign) == 403
    assert guarded.control.phase is DivePhase.IDLE
    page = {"Origin": f"http://{own}", "Sec_Fetch_Site": "same-origin"}
    assert guarded.post("start", **COOKIE, **page) == 202


def test_on_board_no_token_is_needed_but_pages_of_elsewhere_are_refused(on_board: Asked) -> None:
    assert on_board.post("start", Host="evil.example") == 403
    assert on_board.post("start", Origin="http://evil.example") == 403
    assert on_board.post("start") == 202


def test_other_addresses_and_long_bodies_are_refused(guarded: Asked) -> None:
    assert guarded.send("POST", "/dive/sink", **BEARER)[0] == 404
    assert guarded.send("POST", "/health", **BEARER)[0] == 404
    assert guarded.send("POST", "/dive/start", b"x" * (MOST_BYTES + 1), **BEARER)[0] == 413
    assert guarded.send("POST", "/dive/start", Content_Length="-1", **BEARER)[0] == 400
    assert guarded.control.phase is DivePhase.IDLE
    assert guarded.send("POST", "/dive/start", b"{}", **BEARER)[0] == 202


def test_a_get_changes_nothing(guarded: Asked) -> None:
    assert guarded.send("GET", "/dive/start", **BEARER)[0] == 404
    assert guarded.control.phase is DivePhase.IDLE


def test_there_is_no_picture_before_the_first(guarded: Asked) -> None:
    assert guarded.send("GET", "/picture.jpg", **BEARER)[0] == 404
    guarded.jpeg = b"\xff\xd8 picture"
    assert guarded.send("GET", "/picture.jpg")[0] == 403
    assert guarded.send("GET", "/picture.jpg", **BEARER) == (200, guarded.jpeg)
