"""Who gets to the viewer's server, what it sends, and that one who hangs keeps nobody out."""

from __future__ import annotations

import gzip
import http.client
import json
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors import ConfigError, InputError
from aquaflow.config.service import ViewerConfig
from aquaflow.geometry.camera import guess_camera
from aquaflow.geometry.similarity import Sim3
from aquaflow.render import wgsl
from aquaflow.survey.viewer.page import MOST_BYTES, ViewerPage
from tests.survey.viewer.planes import floor

TOKEN = "correct-horse-battery"
Answer = tuple[int, bytes, dict[str, str]]


def filled(config: ViewerConfig) -> ViewerPage:
    page = ViewerPage(config, "test")
    page.show_splats(floor(step=0.2))
    page.show_path(np.array([[x, 0, 0, 1, 0, 0, 0, 1] for x in (0.0, 1.0)], np.float32))
    picture = np.full((24, 32, 3), 99, np.uint8)
    page.show_camera(Sim3.identity(), guess_camera(32, 24), picture)
    return page


@pytest.fixture
def page() -> Iterator[ViewerPage]:
    page = filled(ViewerConfig(port=0))
    yield page
    page.close()


@pytest.fixture
def locked(tmp_path: Path) -> Iterator[ViewerPage]:
    file = tmp_path / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    page = filled(ViewerConfig(port=0, token_file=file))
    yield page
    page.close()


def port_of(page: ViewerPage) -> int:
    return int(page.address.rstrip("/").rpartition(":")[2])


def request(
    page: ViewerPage, method: str, target: str, body: bytes | None = None, **headers: str
) -> Answer:
    connection = http.client.HTTPConnection("127.0.0.1", port_of(page), timeout=20)
    connection.request(method, target, body, headers)
    answer = connection.getresponse()
    found = answer.status, answer.read(), dict(answer.getheaders())
    connection.close()
    return found


def get(page: ViewerPage, target: str, **headers: str) -> Answer:
    return request(page, "GET", target, None, **headers)


def post(page: ViewerPage, tool: str, given: Any, **headers: str) -> tuple[int, dict[str, Any]]:
    body = given if isinstance(given, bytes) else json.dumps(given).encode()
    status, said, _ = request(page, "POST", f"/{tool}", body, **headers)
    return status, json.loads(said)


def test_on_this_machine_everybody_may_look(page: ViewerPage) -> None:
    status, data, headers = get(page, "/")
    assert status == 200
    assert b"AquaFlow" in gzip.decompress(data)
    assert "script-src 'self'" in headers["Content-Security-Policy"]
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]


@pytest.mark.parametrize("target", ["/", "/scene.json", "/client/main.js", "/path/1"])
def test_a_page_of_elsewhere_may_not(page: ViewerPage, target: str) -> None:
    assert get(page, target, Host="evil.example")[0] == 403


@pytest.mark.parametrize("target", ["/", "/scene.json", "/path/1", "/picture/newest"])
def test_the_token_goes_into_a_cookie_and_out_of_the_address(
    locked: ViewerPage, target: str
) -> None:
    assert get(locked, target)[0] == 403
    status, _, headers = get(locked, f"{target}?token={TOKEN}")
    assert (status, headers["Location"]) == (303, target)
    cookie = headers["Set-Cookie"].partition(";")[0]
    assert get(locked, target, Cookie=cookie)[0] == 200
    assert get(locked, target, Cookie=cookie + "x")[0] == 403


@pytest.mark.parametrize("start", ["//evil.example/", "/\\evil.example/", "///evil.example/"])
def test_nobody_is_sent_to_another_server(locked: ViewerPage, start: str) -> None:
    _, _, headers = get(locked, f"{start}?token={TOKEN}")
    assert headers["Location"] in ("/", "/evil.example/")


def test_the_pages_files_are_small_and_sent_again_only_when_they_changed(page: ViewerPage) -> None:
    total = 0
    start = gzip.decompress(get(page, "/")[1]).decode()
    for name in ("/", *re.findall(r"/client/[\w.]+", start)):
        status, data, headers = get(page, name)
        assert (status, headers["Content-Encoding"]) == (200, "gzip")
        assert get(page, name, **{"If-None-Match": headers["ETag"]})[:2] == (304, b"")
        total += len(data)
    assert total < 28_500  # webgpu.js, and what few ask for, come when they are wanted


def test_the_page_gets_the_kernels_that_maps_are_optimised_with(page: ViewerPage) -> None:
    for name in ("project", "sort", "sum"):
        status, data, headers = get(page, f"/client/{name}.wgsl")
        kernels = (Path(wgsl.__file__).parent / f"{name}.wgsl").read_text()
        assert (status, headers["Content-Type"]) == (200, "text/plain; charset=utf-8")
        assert gzip.decompress(data).decode().endswith(kernels)


def test_a_chunk_is_kept_by_the_browser_and_another_map_has_another_address(
    page: ViewerPage,
) -> None:
    about = json.loads(get(page, "/scene.json")[1])["map"]
    status, data, headers = get(page, f"/map/{about['version']}/0")
    assert (status, len(gzip.decompress(data))) == (200, 17 * about["count"])
    assert "immutable" in headers["Cache-Control"]
    page.show_splats(floor(step=0.4))
    assert get(page, f"/map/{about['version']}/0")[0] == 404


def test_path_and_newest_picture_are_sent(page: ViewerPage) -> None:
    rows = np.frombuffer(get(page, "/path/1")[1], "<f4").reshape(-1, 13)
    assert rows[:, 0].tolist() == [0.0, 1.0]
    status, jpeg, headers = get(page, "/picture/newest?3")
    assert (status, jpeg[:2], headers["Content-Type"]) == (200, b"\xff\xd8", "image/jpeg")


@pytest.mark.parametrize(
    "target",
    [
        "/map", "/map/x/0", "/map/x/-1", "/map/x/99999999999", "/picture/0", "/picture/", "/x",
        "/client/", "/client/../__init__.py", "/client/__init__.py", "/picture/%00", "/[",
    ],
)  # fmt: skip
def test_what_is_not_there_is_not_found(page: ViewerPage, target: str) -> None:
    assert get(page, target)[0] == 404


def test_a_point_is_picked_over_http(page: ViewerPage) -> None:
    ray = {"origin": [0, 0, 0], "direction": [0, 0, 1], "pixel_rad": 0.001}
    status, said = post(page, "pick", ray)
    assert status == 200
    assert np.isclose(said["place"][2], 5.0, atol=0.02)


@pytest.mark.parametrize(
    ("tool", "given", "status"),
    [
        ("pick", {"origin": [0, 0, 0], "direction": [0, 0, -1], "pixel_rad": 0}, 422),
        ("pick", {}, 422),
        ("measure", {"what": "area", "points": [1, 2]}, 422),
        ("measure", {"what": "area", "points": []}, 422),
        ("nothing", {}, 422),
        ("notes/add", {"text": "x"}, 422),
        ("pick", b"no json", 400),
        ("pick", b"[]", 400),
        ("pick", b"[" * 60_000, 400),
        ("pick", b"x" * (MOST_BYTES + 1), 400),
    ],
)
def test_bad_input_costs_that_request_alone(
    page: ViewerPage, tool: str, given: Any, status: int
) -> None:
    found, said = post(page, tool, given)
    assert found == status
    assert len(said["error"]) > 10
    assert get(page, "/scene.json")[0] == 200


def test_a_tool_that_fails_is_a_sentence_and_not_the_end(page: ViewerPage) -> None:
    def failing(_: dict[str, Any]) -> dict[str, Any]:
        raise RuntimeError("a bug")

    page._tools.others["broken"] = failing
    assert post(page, "broken", {})[0] == 500
    assert get(page, "/")[0] == 200


def test_only_the_own_page_may_change_anything(page: ViewerPage, locked: ViewerPage) -> None:
    ray = {"origin": [0, 0, 0], "direction": [0, 0, 1], "pixel_rad": 0.001}
    assert post(page, "pick", ray, Origin="http://evil.example")[0] == 403
    assert post(page, "pick", ray, **{"Sec-Fetch-Site": "cross-site"})[0] == 403
    assert post(locked, "pick", ray)[0] == 403
    assert post(locked, f"pick?token={TOKEN}", ray)[0] == 403
    assert post(locked, "pick", ray, Authorization=f"Bearer {TOKEN}")[0] == 200


def test_one_who_sends_no_end_of_a_request_keeps_nobody_out(page: ViewerPage) -> None:
    with socket.create_connection(("127.0.0.1", port_of(page)), timeout=20) as flood:
        flood.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 100)
        assert get(page, "/")[0] == 200
        flood.sendall(b"x" * 200_000)
        assert get(page, "/")[0] == 200


def test_an_address_beyond_loopback_needs_a_token() -> None:
    with pytest.raises(ValueError, match="token_file"):
        ViewerConfig(enabled=True, host="0.0.0.0", port=0)


def test_a_taken_address_is_one_sentence(page: ViewerPage) -> None:
    with pytest.raises(InputError, match=r"viewer\.port"):
        ViewerPage(ViewerConfig(port=port_of(page)), "test")


def test_a_token_that_others_may_read_lets_nobody_in(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text(TOKEN)
    file.chmod(0o644)
    with pytest.raises(ConfigError):
        ViewerPage(ViewerConfig(port=0, token_file=file), "test")
