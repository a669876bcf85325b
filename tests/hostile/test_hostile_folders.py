"""Folders from others: links and special files in them are neither read nor written through, and
archives that unpack to gigabytes take no memory."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import subprocess
import sys
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aquaflow.dive.ply import read_ply
from aquaflow.lab.batch.manifest import files_of
from tests.command_line import Cli, refused

MORE_MB = 300
"""Most that a bomb may take beyond the same command without it."""
THEIRS = b"theirs, and none of AquaFlow's business\n"
pytestmark = pytest.mark.timeout(300)


@pytest.fixture
def dive(small_dive: Path, tmp_path: Path) -> Path:
    return shutil.copytree(small_dive, tmp_path / "dive")


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    path = tmp_path / "outside"
    path.write_bytes(THEIRS)
    return path


READ = (
    ("report", "metrics.json"), ("report", "frames.csv"), ("report", "camera.yaml"),
    ("report", "coverage.npz"), ("report", "medium.json"), ("report", "trajectory.csv"),
    ("measure", "metric.json"), ("measure", "notes.geojson"),
    ("site", "places.npz"),
    ("view", "trajectory.tum"), ("view", "camera.yaml"),
)  # fmt: skip


def words_of(command: str, dive: Path) -> list[object]:
    if command == "measure":
        return ["measure", dive, "--notes"]
    if command == "site":
        return ["site", "add", dive.parent / "site", dive]
    if command == "report":
        return ["export", "report", dive]
    return [command, dive]


@pytest.mark.parametrize(("command_name", "name"), READ)
def test_no_link_is_followed_to_a_file_outside(
    dive: Path, tmp_path: Path, command: Cli, command_name: str, name: str
) -> None:
    path, kept = dive / name, tmp_path / "kept"
    if path.exists():
        path.rename(kept)
    else:
        kept.write_text("{}")
    path.symlink_to(kept)
    refused(command(*words_of(command_name, dive)), name, "link")


@pytest.mark.parametrize("name", ["frames.csv", "camera.yaml", "trajectory.csv", "coverage.npz"])
def test_a_fifo_is_not_waited_for(dive: Path, command: Cli, name: str) -> None:
    (dive / name).unlink()
    os.mkfifo(dive / name)
    refused(command("export", "report", dive), name, "no regular file")


def test_a_note_is_written_through_no_link(dive: Path, command: Cli, outside: Path) -> None:
    (dive / ".notes.geojson.part").symlink_to(outside)
    splats = read_ply(dive / "map.ply")
    ends = splats.means[splats.opacities.argsort()[-2:]].tolist()
    points = [f"--point={x},{y},{z}" for x, y, z in ends]
    ran = command("measure", dive, *points, "--note", "here")
    assert ran.code == 0, ran.err
    assert outside.read_bytes() == THEIRS
    assert "here" in (dive / "notes.geojson").read_text()


@pytest.mark.parametrize("folder", ["pictures", "heldout", "work", "checkpoint"])
def test_a_dive_is_not_mapped_anew_through_a_linked_folder(
    dive: Path, tmp_path: Path, pictures: Path, command: Cli, folder: str
) -> None:
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    for name in ("000000.jpg", "000000_real.png", "state.npz"):
        (theirs / name).write_bytes(THEIRS)
    shutil.rmtree(dive / folder, ignore_errors=True)
    (dive / folder).symlink_to(theirs)
    refused(command("map", pictures, "--out", dive, "--overwrite"), folder, "link")
    assert {path.read_bytes() for path in theirs.iterdir()} == {THEIRS}
    assert len(list(theirs.iterdir())) == 3


def test_the_log_of_a_dive_is_not_appended_to_the_target_of_a_link(
    dive: Path, pictures: Path, command: Cli, outside: Path
) -> None:
    (dive / "log.jsonl").unlink()
    (dive / "log.jsonl").symlink_to(outside)
    command("map", pictures, "--out", dive, "--overwrite")
    assert outside.read_bytes() == THEIRS


def test_a_batch_packs_only_regular_files_that_lie_in_the_dive(dive: Path, outside: Path) -> None:
    (dive / "more").mkdir()
    (dive / "more" / "file").write_bytes(b"ours")
    (dive / "link").symlink_to(outside)
    (dive / "folder").symlink_to(outside.parent)
    os.mkfifo(dive / "fifo")
    found = {path.relative_to(dive).as_posix() for path in files_of(dive)}
    assert "more/file" in found
    assert not {name for name in found if name.startswith(("link", "folder", "fifo"))}


class Viewed:
    """``aquaflow view`` in a process of its own."""

    def __init__(self, dive: Path) -> None:
        words = [str(Path(sys.executable).with_name("aquaflow")), "view", str(dive), "--port", "0"]
        self._process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        said = self._process.stdout.readline()
        found = re.search(r"http://\S+", said)
        assert found is not None, said
        self.address = found[0]

    def get(self, path: str) -> bytes:
        with urllib.request.urlopen(self.address + path, timeout=60) as answer:
            return bytes(answer.read())

    def peak_mb(self) -> float:
        status = Path(f"/proc/{self._process.pid}/status").read_text()
        found = re.search(r"VmHWM:\s+(\d+)", status)
        assert found is not None
        return int(found[1]) / 1024.0

    def close(self) -> None:
        self._process.terminate()
        self._process.communicate()


def test_the_viewer_serves_no_picture_from_elsewhere_and_packs_through_no_link(
    dive: Path, outside: Path
) -> None:
    (dive / "pictures").mkdir(exist_ok=True)
    (dive / "pictures" / "000000.jpg").unlink(missing_ok=True)
    (dive / "pictures" / "000000.jpg").symlink_to(outside)
    for path in (dive / "heldout").glob("*"):
        path.unlink()
    (dive / "heldout" / "000001_real.png").symlink_to(outside)
    (dive / ".view.zip.part").symlink_to(outside)
    viewed = Viewed(dive)
    try:
        for number in (0, 1):
            with pytest.raises(urllib.error.HTTPError) as refusal:
                viewed.get(f"picture/{number}")
            assert refusal.value.code == 404
        while not (dive / "view.zip").exists():  # packed behind the page
            viewed.get("scene.json")
    finally:
        viewed.close()
    assert outside.read_bytes() == THEIRS


# --- bombs ------------------------------------------------------------------------------------


MEASURED = """
import os, subprocess, sys
process = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL)
_, status, used = os.wait4(process.pid, 0)
print(used.ru_maxrss / 1024.0)
sys.exit(os.waitstatus_to_exitcode(status))
"""
"""A small process starts what is measured: Linux counts the memory of whoever starts a program to
its peak, and the one that runs these tests has a gigabyte."""


def peak_mb(*words: object) -> tuple[float, int, str]:
    """Peak memory of ``aquaflow``, its exit status and what it said."""
    command = [str(Path(sys.executable).with_name("aquaflow")), *map(str, words)]
    ran = subprocess.run(
        [sys.executable, "-S", "-c", MEASURED, *command],
        capture_output=True,
        text=True,
        check=False,
    )
    return float(ran.stdout), ran.returncode, ran.stderr


def zeros(archive: zipfile.ZipFile, name: str, dtype: object, count: int) -> None:
    """An array of zeros, compressed a thousand times."""
    head = io.BytesIO()
    described = np.lib.format.dtype_to_descr(np.dtype(dtype))
    np.lib.format.write_array_header_1_0(
        head, {"descr": described, "fortran_order": False, "shape": (count,)}
    )
    block = bytes(1 << 24)
    left = count * np.dtype(dtype).itemsize
    with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
        stream.write(head.getvalue())
        while left > 0:
            stream.write(block[:left])
            left -= len(block)


def replaced(path: Path, name: str, dtype: object, count: int) -> None:
    """``path`` with another array ``name``."""
    members = {}
    with zipfile.ZipFile(path) as old:
        members = {each: old.read(each) for each in old.namelist() if each != f"{name}.npy"}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for each, data in members.items():
            archive.writestr(each, data)
        zeros(archive, name, dtype, count)


PLACES_BOMBS = {"index": 3_000_000, "edges": 1_000_000, "about": 1 << 29}


@pytest.mark.parametrize("name", ["edges", "about", pytest.param("index", marks=pytest.mark.slow)])
def test_places_that_unpack_to_gigabytes_take_no_memory(dive: Path, name: str) -> None:
    from aquaflow.keyframes.place import EDGE, PLACE

    usual, code, said = peak_mb("site", "add", dive.parent / "a", dive)
    assert code == 0, said
    dtype = {"index": PLACE, "edges": EDGE, "about": "u1"}[name]
    replaced(dive / "places.npz", name, dtype, PLACES_BOMBS[name])
    found, code, said = peak_mb("site", "add", dive.parent / "b", dive)
    assert (code, said.count("\n")) == (1, 1)
    assert "places.npz" in said
    print(f"\npeak {usual:.0f} MB, with the bomb {found:.0f} MB")
    assert found <= usual + MORE_MB


def test_a_dive_is_not_looked_for_in_places_that_unpack_to_gigabytes(
    dive: Path, pictures: Path, tmp_path: Path
) -> None:
    from aquaflow.keyframes.place import EDGE

    usual, _, said = peak_mb("map", pictures, "--out", tmp_path / "a", "--in", tmp_path / "none")
    replaced(dive / "places.npz", "edges", EDGE, PLACES_BOMBS["edges"])
    found, code, said = peak_mb("map", pictures, "--out", tmp_path / "b", "--in", dive)
    assert code == 1
    assert "places.npz" in said
    print(f"\npeak {usual:.0f} MB, with the bomb {found:.0f} MB")
    assert found <= usual + MORE_MB


def test_coverage_that_unpacks_to_gigabytes_takes_no_memory(dive: Path) -> None:
    usual, code, said = peak_mb("export", "report", dive)
    assert code == 0, said
    replaced(dive / "coverage.npz", "0.views", "u2", 1 << 29)
    found, code, said = peak_mb("export", "report", dive)
    assert (code, said.count("\n")) == (1, 1)
    assert "coverage.npz" in said
    print(f"\npeak {usual:.0f} MB, with the bomb {found:.0f} MB")
    assert found <= usual + MORE_MB


def about_is_a_bomb(path: Path) -> None:
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("about.json", "w", force_zip64=True) as stream,
    ):
        for _ in range(64):
            stream.write(b" " * (1 << 24))


def chunk_is_a_bomb(path: Path) -> None:
    with zipfile.ZipFile(path) as old:
        about = old.read("about.json")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("about.json", about)
        with archive.open("0", "w", force_zip64=True) as stream:
            for _ in range(64):
                stream.write(bytes(1 << 24))


@pytest.mark.parametrize("make", [about_is_a_bomb, chunk_is_a_bomb])
def test_a_packed_map_that_unpacks_to_gigabytes_takes_no_memory(
    dive: Path, make: Callable[[Path], None]
) -> None:
    def seen() -> float:
        viewed = Viewed(dive)
        try:
            shown = json.loads(viewed.get("scene.json"))["map"]
            assert len(viewed.get(f"map/{shown['version']}/0")) < 1 << 24
            while not (dive / "view.zip").exists():  # packed behind the page
                viewed.get("scene.json")
            return viewed.peak_mb()
        finally:
            viewed.close()

    usual = seen()
    assert (dive / "view.zip").exists()
    make(dive / "view.zip")
    found = seen()
    print(f"\npeak {usual:.0f} MB, with the bomb {found:.0f} MB")
    assert found <= usual + MORE_MB


def test_a_map_whose_header_claims_a_billion_gaussians_takes_no_memory(dive: Path) -> None:
    ply = dive / "map.ply"
    head, end, body = ply.read_bytes().partition(b"end_header\n")
    ply.write_bytes(re.sub(rb"vertex \d+", b"vertex 1000000000", head) + end + body)
    found, code, said = peak_mb(
        "export", dive, "--format", "laz", "--water", "--out", dive.parent / "out.laz"
    )
    assert code == 1, said
    assert found <= 1000.0


def test_a_long_json_file_is_refused(dive: Path, command: Cli) -> None:
    with (dive / "metrics.json").open("r+b") as stream:
        stream.truncate(1 << 33)  # a hole: it takes no room on the disk
    refused(command("export", "report", dive), "metrics.json", "MB")
