"""Small seasons, a site's files to compare, and a recording that kills whoever opens it."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from typing import Any

from aquaflow.lab.batch.season import JOURNAL
from tests.small_recording import GIVE_UP_S

FROM_RUN_TO_RUN = {"metrics.json", "report.html", "log.jsonl", "manifest.json"}
"""Files of a dive that hold times and what the machine is; docs/batch.md says so."""

SHORT = ("--tracking-only", "--width", "96")
"""A dive without torch, in a second or two."""

POISON = """
import os, pathlib, signal, sys, time
from aquaflow.sources import open_recording

MAPPING = "job_process" in " ".join(sys.orig_argv)

class Poison:
    specificity = 9
    @classmethod
    def recognises(cls, path):
        return path.suffix in (".poison", ".once", ".hold")
    @classmethod
    def open(cls, path, fps=None):
        first = path.with_name(path.name + "-begun")
        if path.suffix == ".poison":
            os.kill(os.getpid(), signal.SIGSEGV)
        elif MAPPING and not first.exists():
            first.write_text(str(os.getppid()))
            while path.suffix == ".hold":
                time.sleep(0.1)
            os.kill(os.getpid(), signal.SIGKILL)
        return open_recording(pathlib.Path(path.read_text()), fps)
"""
"""A source of files that name a recording: ``.poison`` crashes the process that opens it, as a
broken codec may; ``.once`` kills its first attempt; of ``.hold`` the first attempt never ends."""


def wait_for(file: Path) -> str:
    """Content of a file that another process is about to write."""
    give_up_s = time.monotonic() + GIVE_UP_S
    while not (file.exists() and file.read_text()):
        assert time.monotonic() < give_up_s, f"{file} did not come"
        time.sleep(0.1)
    return file.read_text()


def season(folder: Path, recording: Path, dives: int, pictures: int = 8) -> Path:
    """A folder of ``dives`` recordings: ``pictures`` of ``recording`` from the i-th on."""
    files = sorted((recording / "images").glob("*.*")) or sorted(recording.glob("*.png"))
    for dive in range(dives):
        made = folder / f"dive{dive}"
        made.mkdir(parents=True)
        for file in files[dive : dive + pictures]:
            shutil.copy(file, made / file.name)
        shutil.copy(recording / "camera.yaml", made)
    return folder


def contents(site: Path) -> dict[str, bytes]:
    """The files of every dive that are the same whoever made them."""
    dives = site / "dives"
    return {
        path.relative_to(dives).as_posix(): path.read_bytes()
        for path in sorted(dives.rglob("*"))
        if path.is_file() and path.name not in FROM_RUN_TO_RUN
    }


def read_journal(path: Path) -> list[dict[str, Any]]:
    """The whole lines of a journal, in order; none where there is no journal."""
    try:
        text = path.read_bytes()
    except OSError:
        return []
    whole = text[: text.rfind(b"\n") + 1]
    return [json.loads(line) for line in whole.splitlines()]


def events(site: Path, event: str) -> list[dict[str, Any]]:
    """Lines of the site's journal."""
    return [line for line in read_journal(site / JOURNAL) if line["event"] == event]


def leftovers(site: Path) -> list[Path]:
    """Working folders that no one removed."""
    return list((site / "dives").glob(".*"))


def install_poison(folder: Path) -> Path:
    """A package in ``folder``, to be put on PYTHONPATH, that adds the source POISON."""
    info = folder / "poison-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: poison\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[aquaflow.cameras]\npoison = poison:Poison\n")
    (folder / "poison.py").write_text(POISON)
    return folder
