"""`aquaflow lab batch` on this machine: whole dives, whatever some of the recordings do."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from aquaflow.lab.batch.batch import Examiner
from tests.lab.batch.seasons import (  # fmt: skip
    SHORT,
    contents,
    events,
    install_poison,
    leftovers,
    season,
    wait_for,
)

AQUAFLOW = str(Path(sys.executable).with_name("aquaflow"))


@pytest.fixture(scope="module")
def recordings(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two that can be mapped, one killed at its first attempt, one that crashes, one of garbage."""
    folder = season(tmp_path_factory.mktemp("dives"), small_recording, 2)
    (folder / "crashing.poison").write_text("")
    (folder / "killed.once").write_text(str(folder / "dive0"))
    (folder / "garbage.mp4").write_bytes(bytes(range(256)) * 20)
    return folder


@pytest.fixture(scope="module")
def poisoned(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment in which the crashing recordings can be opened."""
    package = install_poison(tmp_path_factory.mktemp("poison"))
    path = os.pathsep.join([str(package), os.environ.get("PYTHONPATH", "")])
    return dict(os.environ) | {"PYTHONPATH": path}


def run_batch(
    environment: dict[str, str], *arguments: object, room_bytes: int | None = None
) -> subprocess.CompletedProcess[str]:
    def limited() -> None:
        if room_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (room_bytes, room_bytes))

    if room_bytes is not None:  # Python cuts a compiled module short without a word
        environment = environment | {"PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        [AQUAFLOW, "lab", "batch", *map(str, arguments)],
        env=environment, capture_output=True, text=True, check=False, preexec_fn=limited,
    )  # fmt: skip


@pytest.fixture(scope="module")
def site(
    recordings: Path, poisoned: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """The site of ``recordings``, and what the command said."""
    out = tmp_path_factory.mktemp("site")
    ran = run_batch(poisoned, recordings, "--out", out, *SHORT, "--retries", 1)
    return out, ran


Ran = tuple[Path, subprocess.CompletedProcess[str]]


@pytest.mark.ci
def test_one_poisoned_recording_costs_itself_alone(site: Ran) -> None:
    out, ran = site
    assert ran.returncode == 1
    assert "Traceback" not in ran.stderr + ran.stdout
    made = sorted(path.name for path in (out / "dives").iterdir())
    assert made == ["dive0", "dive1", "killed"]
    assert "3 of 5 dives are there" in ran.stdout
    assert "crashing: its process crashed (SIGSEGV)" in ran.stdout
    assert "garbage.mp4 cannot be read as a video" in ran.stdout
    assert leftovers(out) == []


@pytest.mark.ci
def test_a_killed_attempt_is_made_again_and_a_crash_no_more_often_than_asked(site: Ran) -> None:
    out, _ = site
    begun = [line["dive"] for line in events(out, "started")]
    assert {name: begun.count(name) for name in begun} == {
        "crashing": 2, "killed": 2, "dive0": 1, "dive1": 1, "garbage": 1,
    }  # fmt: skip
    assert [line["dive"] for line in events(out, "lost")].count("killed") == 1


@pytest.mark.ci
def test_a_dive_of_a_batch_has_the_bytes_of_map(
    site: Ran, recordings: Path, tmp_path: Path
) -> None:
    out, _ = site
    alone = tmp_path / "dives" / "dive0"
    mapped = subprocess.run(
        [AQUAFLOW, "map", str(recordings / "dive0"), "--out", str(alone), *SHORT, "--threads", "1"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert mapped.returncode in (0, 3), mapped.stderr
    in_batch = {name: text for name, text in contents(out).items() if name.startswith("dive0/")}
    assert contents(tmp_path) == in_batch
    assert len(in_batch) > 5


@pytest.mark.ci
def test_again_nothing_is_done_twice_and_other_settings_are_refused(
    site: Ran, recordings: Path, poisoned: dict[str, str]
) -> None:
    out, _ = site
    before = contents(out)
    (out / "list.txt").write_text(f"{recordings / 'dive0'}\n{recordings / 'dive1'}\n")
    again = run_batch(poisoned, out / "list.txt", "--out", out, *SHORT, "--json")
    assert again.returncode == 0, again.stderr
    dives = json.loads(again.stdout)["dives"]
    assert [dives[name]["earlier"] for name in ("dive0", "dive1")] == [True, True]
    other = run_batch(poisoned, out / "list.txt", "--out", out, *SHORT[:-1], "88")
    assert other.returncode == 1
    assert "with other settings" in other.stdout
    assert contents(out) == before


@pytest.mark.slow
def test_a_full_disk_ends_the_batch_in_a_sentence_and_room_lets_it_go_on(
    recordings: Path, poisoned: dict[str, str], tmp_path: Path
) -> None:
    (tmp_path / "list.txt").write_text(f"{recordings / 'dive0'}\n")
    given = (tmp_path / "list.txt", "--out", tmp_path / "site", *SHORT)
    full = run_batch(poisoned, *given, room_bytes=3000)
    assert full.returncode == 1
    assert "The batch ended early: the disk is full" in full.stdout
    assert list((tmp_path / "site" / "dives").iterdir()) == []
    assert run_batch(poisoned, *given).returncode in (0, 3)
    assert [path.name for path in (tmp_path / "site" / "dives").iterdir()] == ["dive0"]


@pytest.mark.slow
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_a_batch_that_is_stopped_leaves_no_process_and_can_be_continued(
    recordings: Path, poisoned: dict[str, str], tmp_path: Path, end: signal.Signals
) -> None:
    held = tmp_path / "long.hold"
    held.write_text(str(recordings / "dive0"))
    (tmp_path / "list.txt").write_text("long.hold\n")
    command = (AQUAFLOW, "lab", "batch", tmp_path / "list.txt", "--out", tmp_path / "site", *SHORT)
    running = subprocess.Popen(
        [*map(str, command)], env=poisoned, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, start_new_session=True,
    )  # fmt: skip
    wait_for(tmp_path / "long.hold-begun")
    os.kill(running.pid, end)
    said, _ = running.communicate()  # ends when no process holds its output any more
    assert running.returncode == (130 if end is signal.SIGINT else -signal.SIGKILL)
    if end is signal.SIGINT:
        assert "give the same command again" in said
        assert leftovers(tmp_path / "site") == []
    again = run_batch(poisoned, *command[2:])
    assert again.returncode in (0, 3), again.stdout
    assert [path.name for path in (tmp_path / "site" / "dives").iterdir()] == ["long"]


def test_two_batches_never_write_to_one_site(
    recordings: Path, poisoned: dict[str, str], tmp_path: Path
) -> None:
    from aquaflow.base.storage.whole_folder import FolderLock

    lock = FolderLock(tmp_path)
    ran = run_batch(poisoned, recordings, "--out", tmp_path, *SHORT)
    lock.release()
    assert ran.returncode == 1
    assert "held by a running aquaflow" in ran.stderr


def test_looking_at_a_recording_that_crashes_tells_nothing_and_the_next_is_looked_at(
    recordings: Path, poisoned: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", poisoned["PYTHONPATH"])
    with Examiner() as examiner:
        assert examiner.look(str(recordings / "crashing.poison")).frames is None
        seen = examiner.look(str(recordings / "dive0"))
    assert (seen.frames, seen.width, seen.height) == (8, 160, 120)
