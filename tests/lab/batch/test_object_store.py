"""Recordings from an object store, dives into one: whole, or not at all."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest

from aquaflow.base.errors import InputError
from aquaflow.lab.batch.job import BatchJob, BatchOutcome
from aquaflow.lab.batch.manifest import MANIFEST, write_manifest
from aquaflow.lab.batch.object_store import ObjectStore, StoreError
from aquaflow.lab.batch.recordings import find_recordings
from aquaflow.lab.batch.site import open_site
from tests.command_line import Cli
from tests.lab.batch.seasons import SHORT, season

SITE = "memory://season/site"


@pytest.fixture
def memory() -> Iterator[fsspec.AbstractFileSystem]:
    system = fsspec.filesystem("memory")
    yield system
    system.rm("/", recursive=True)


def job(site: str, cache: Path, name: str = "d") -> BatchJob:
    return BatchJob(name, "x", 1, site, str(cache), {"threads": 1}, None, 1, 100)


def a_dive(folder: Path, made_for: BatchJob) -> Path:
    (folder / "heldout").mkdir(parents=True)
    (folder / "frames.csv").write_text("frame\n")
    (folder / "heldout" / "1.png").write_bytes(b"png")
    write_manifest(folder, made_for, BatchOutcome("done", frames=3))
    return folder


def test_a_season_in_a_store_becomes_dives_in_a_store(
    memory: fsspec.AbstractFileSystem, small_recording: Path, tmp_path: Path, command: Cli
) -> None:
    local = season(tmp_path / "dives", small_recording, 1)
    memory.put(str(local), "/season/dives", recursive=True)
    cache = tmp_path / "cache"
    given = ("memory://season/dives", "--out", SITE, "--cache", cache, *SHORT, "--json")
    ran = command("lab", "batch", *given)
    assert ran.code in (0, 3), ran.err
    manifest = json.loads(memory.cat_file("/season/site/dives/dive0/manifest.json"))
    files = {
        name: memory.info(f"/season/site/dives/dive0/{name}")["size"] for name in manifest["files"]
    }
    assert files == {name: each["bytes"] for name, each in manifest["files"].items()}
    assert "frames.csv" in files
    assert memory.exists("/season/site/batch.jsonl")
    assert [path.name for path in cache.iterdir()] == ["batch.jsonl"]
    again = command("lab", "batch", *given)
    assert json.loads(again.out)["dives"]["dive0"]["earlier"]


def test_an_upload_that_is_cut_off_is_no_dive_and_the_next_one_is_whole(
    memory: fsspec.AbstractFileSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made_for = job(SITE, tmp_path)
    dive = a_dive(tmp_path / "dive", made_for)
    site = open_site(SITE)
    put, left = ObjectStore.put, [2]

    def cut_off(self: ObjectStore, local: Path, name: str) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise StoreError("the line is dead")
        put(self, local, name)

    monkeypatch.setattr(ObjectStore, "put", cut_off)
    with pytest.raises(StoreError):
        site.publish(dive, made_for)
    assert memory.exists("/season/site/dives/d/frames.csv")
    assert site.finished_outcome(made_for) is None
    memory.pipe_file("/season/site/dives/d/of_an_older_attempt", b"x")
    monkeypatch.setattr(ObjectStore, "put", put)
    site.publish(dive, made_for)
    found = site.finished_outcome(made_for)
    assert found is not None
    assert (found.earlier, found.frames) == (True, 3)
    assert not memory.exists("/season/site/dives/d/of_an_older_attempt")


@pytest.mark.parametrize("place", ["folder", "store"])
def test_a_second_machine_that_ends_later_changes_nothing(
    memory: fsspec.AbstractFileSystem, tmp_path: Path, place: str
) -> None:
    where = SITE if place == "store" else str(tmp_path / "site")
    made_for = job(where, tmp_path)
    site = open_site(where)
    (tmp_path / "site" / "dives").mkdir(parents=True)
    site.publish(a_dive(tmp_path / "one", made_for), made_for)
    late = a_dive(tmp_path / "two", made_for)
    (late / "frames.csv").write_text("another\n")
    site.publish(late, made_for)
    found = site.finished_outcome(made_for)
    assert found is not None
    assert found.frames == 3
    with pytest.raises(InputError, match="other settings"):
        site.finished_outcome(BatchJob(**{**made_for.to_json(), "settings": {"threads": 2}}))


def test_a_damaged_manifest_is_told(memory: fsspec.AbstractFileSystem, tmp_path: Path) -> None:
    memory.pipe_file(f"/season/site/dives/d/{MANIFEST}", b"{}")
    with pytest.raises(InputError, match="damaged"):
        open_site(SITE).finished_outcome(job(SITE, tmp_path))


def test_a_store_is_listed_by_what_may_be_a_recording(memory: fsspec.AbstractFileSystem) -> None:
    for name in ("a.mp4", "b/images/1.png", "camera.yaml", ".hidden.mp4"):
        memory.pipe_file(f"/season/dives/{name}", b"12345")
    found = find_recordings("memory://season/dives")
    assert [(each.name, each.size_bytes) for each in found] == [("a", 5), ("b", 5)]


@pytest.mark.parametrize("url", ["nonsense://x/y", "s3x://bucket", "memory://nowhere"])
def test_a_store_that_is_none_is_told_in_a_sentence(url: str, command: Cli, tmp_path: Path) -> None:
    ran = command("lab", "batch", url, "--out", tmp_path / "site")
    assert ran.code == 1
    [line] = ran.err.splitlines()
    assert url in line
