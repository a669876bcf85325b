"""``aquaflow map --view``: a dive is looked at while it is mapped, and is the same dive."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from aquaflow.base.errors.crash_report import INTERRUPTED, STOPPED
from aquaflow.config import Config
from aquaflow.config.service import ViewerConfig
from aquaflow.dive.preview import Preview
from aquaflow.dive.replay import map_recording
from aquaflow.sources import open_recording
from tests.command_line import Cli
from tests.small_recording import FRAMES, GIVE_UP_S, HASTY, QUICK

USUAL_PORT = ViewerConfig().port
TIMED = {
    *("wall_s", "fps", "stage_ms", "peak_rss_mb", "cpu_s", "ms_per_frame"),
    *("time_to_first_pose_s", "adjustments", "recording"),
}
"""Keys of metrics.json that differ between two runs of the same recording."""
OTHER_FILES = {"log.jsonl", "metrics.json", "report.html", "view.zip"}
"""Files that tell how long it took, and the viewer's own."""

ASK_S = 0.2
"""Between two questions; the page asks twice a second."""
PAUSE_S = 0.6
"""Which a command stands still after each question: a map is shown anew after three seconds, and a
fast machine has mapped the whole dive by then."""

Scene = dict[str, Any]


@pytest.fixture
def usual_port_taken() -> Iterator[None]:
    """By another viewer."""
    with contextlib.ExitStack() as around:
        with contextlib.suppress(OSError):  # something else has it already
            around.enter_context(socket.create_server(("127.0.0.1", USUAL_PORT)))
        yield


def asked(address: str) -> Scene:
    with urllib.request.urlopen(f"{address}scene.json", timeout=GIVE_UP_S) as answer:
        scene: Scene = json.load(answer)
        return scene


def disconnect(address: str) -> None:
    """A browser whose window is closed in the middle of a question."""
    port = int(address.rstrip("/").rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port), GIVE_UP_S) as client:
        client.sendall(b"GET /scene.json HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET /pic")


def stand_still(process_id: int) -> None:
    """For PAUSE_S."""
    os.kill(process_id, signal.SIGSTOP)
    try:
        time.sleep(PAUSE_S)
    finally:
        os.kill(process_id, signal.SIGCONT)


def said(process_id: int, pattern: str, stream: int = 2) -> str:
    """What a running command prints, by default on stderr, once it does."""
    printed = Path(f"/proc/{process_id}/fd/{stream}")
    return waited(lambda: re.search(pattern, printed.read_text()), pattern).group(1)


def waited(look: Callable[[], Any], what: str) -> Any:
    end_s = time.monotonic() + GIVE_UP_S
    while not (found := look()):
        assert time.monotonic() < end_s, f"waited in vain for {what}"
        time.sleep(ASK_S)
    return found


def results(dive: Path) -> dict[str, bytes]:
    """Files of a dive and numbers of its metrics that repeat."""
    files = (path for path in dive.rglob("*") if path.is_file())
    found = {str(path.relative_to(dive)): path.read_bytes() for path in files}
    numbers = json.loads(found["metrics.json"])
    whole = {name: data for name, data in found.items() if name not in OTHER_FILES}
    kept = {key: value for key, value in numbers.items() if key not in TIMED}
    return whole | {"metrics.json": json.dumps(kept).encode()}


@pytest.mark.usefixtures("usual_port_taken")
def test_a_dive_is_seen_to_grow_and_then_finished_and_its_files_are_the_same(
    aquaflow: Cli, small_recording: Path, small_dive: Path, tmp_path: Path
) -> None:
    dive, scenes = tmp_path / "dive", list[Scene]()

    def look_on(process_id: int) -> None:
        try:
            address = said(process_id, r"Open (http://127\.0\.0\.1:\d+/) in a browser")
            assert f":{USUAL_PORT}/" not in address
            disconnect(address)
            while not scenes or scenes[-1]["live"]:
                with contextlib.suppress(OSError):  # the finished dive is being read
                    scenes.append(asked(address))
                stand_still(process_id)
                time.sleep(ASK_S)
            assert said(process_id, r"Open (\S+) in a browser; Ctrl-C", stream=1) == address
        finally:
            os.kill(process_id, signal.SIGINT)

    ran = aquaflow("map", small_recording, "--out", dive, *QUICK, "--view", meanwhile=look_on)
    assert ran.code == 0, ran.err
    assert f"{FRAMES} of {FRAMES} frames posed" in ran.out
    finished = scenes[-1]
    # The finished dive's page is live, too, until all that it shows has come.
    live = [scene for scene in scenes if scene["live"] and scene["title"] != finished["title"]]
    lengths = [scene["path"]["count"] for scene in live]
    assert lengths == sorted(lengths)
    assert len(set(lengths)) > 3
    counts = {scene["map"]["count"] for scene in live if scene["map"]}
    assert max(counts) > min(counts) > 100
    assert any(scene["camera"] and scene["camera"]["picture"] for scene in live)
    assert any(re.match(r"map: \d+ of 24", scene["health"]) for scene in live)
    assert any(scene["health"].startswith("refine: ") for scene in live)
    assert finished["map"]["count"] > 100
    assert finished["path"]["count"] == FRAMES
    assert results(dive) == results(small_dive)


def test_ctrl_c_ends_a_mapping_that_is_looked_at_as_any_other(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    addresses = list[str]()

    def interrupt(process_id: int) -> None:
        try:
            addresses.append(said(process_id, r"Open (\S+) in a browser"))
            waited(lambda: asked(addresses[0])["path"]["count"], "a pose")
        finally:
            os.kill(process_id, signal.SIGINT)

    words = ("map", small_recording, "--out", tmp_path / "dive", *HASTY, "--view")
    ran = aquaflow(*words, meanwhile=interrupt)
    assert ran.code == INTERRUPTED
    assert ran.err.splitlines()[-1] == f"aquaflow: {STOPPED}"
    with pytest.raises(OSError, match="refused"):
        asked(addresses[0])


def test_with_json_the_page_ends_with_the_command(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    dive = tmp_path / "dive"
    words = ("--out", dive, "--stop", 10, "--tracking-only", "--view", "--json")
    ran = aquaflow("map", small_recording, *words)
    assert json.loads(ran.out)["dive"] == str(dive)
    assert "to see the path, as without a map there is none, grow" in ran.err


def test_of_a_dive_without_a_map_the_path_is_shown_also_when_it_is_finished(
    small_recording: Path, tmp_path: Path
) -> None:
    config = Config.model_validate({"mapping": {"enabled": False}, "source": {"stop": 12}})
    with Preview() as preview:
        # Frame by frame as slowly as the page takes poses.
        done = map_recording(
            open_recording(small_recording), "x", tmp_path / "dive", config, preview=preview,
            progress=lambda *_: time.sleep(1.0 / ViewerConfig().pose_hz),
        )  # fmt: skip
        preview.finish(done.dive)
        waited(lambda: asked(preview.address)["health"].startswith("finished: "), "its end")
        scene = asked(preview.address)
    assert scene["map"] is None
    assert scene["path"]["count"] > 1
    assert "no map is made" in scene["health"]
