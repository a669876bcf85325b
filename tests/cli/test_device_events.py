"""``aquaflow run`` tells of its devices at once, on stderr, and in the dive's log."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import yaml

from tests.command_line import Cli
from tests.drivers.simulated_links import until

ABSENT = "http://127.0.0.1:1/video"
"""Nothing listens on port 1."""


def test_a_camera_that_is_not_there_is_told_on_stderr_and_in_the_log(
    aquaflow: Cli, tmp_path: Path
) -> None:
    settings = {
        "cameras": {"front": {"kind": "stream", "url": ABSENT, "first_retry_s": 0.05}},
        "service": {"health": {"enabled": False, "port": 8230}},
    }
    (tmp_path / "vehicle.yaml").write_text(yaml.safe_dump(settings))
    dive = tmp_path / "dive"
    log = dive / "log.jsonl"

    def stop_when_told(process_id: int) -> None:
        until(lambda: log.exists() and ABSENT in log.read_text())
        os.kill(process_id, signal.SIGINT)

    words = ("run", "--config", tmp_path / "vehicle.yaml", "--out", dive)
    ran = aquaflow(*words, meanwhile=stop_when_told)
    told = f"camera 'front' is waited for: no video from {ABSENT}"
    first, last = ran.err.splitlines()
    assert first == told
    assert last == f"dive: no frame could be read, see {dive / 'frames.csv'}"
    lines = [json.loads(line) for line in (dive / "log.jsonl").read_text().splitlines()]
    about = [line for line in lines if line.get("source") == "front"]
    assert [(line["event"], line["message"], line["t_s"]) for line in about] == [
        ("waiting", told, None)
    ]
