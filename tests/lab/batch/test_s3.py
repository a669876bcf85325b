"""A batch from and to a server that speaks S3."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.command_line import Cli
from tests.lab.batch.seasons import SHORT, season

WHY = "pip install 'aquaflow[s3-tests]'"


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """URL of an empty bucket."""
    server = pytest.importorskip("moto.server", reason=WHY)
    s3fs = pytest.importorskip("s3fs", reason=WHY)
    serving = server.ThreadedMotoServer("127.0.0.1", 0)
    serving.start()
    host, port = serving.get_host_and_port()
    for name, value in (
        ("AWS_ENDPOINT_URL", f"http://{host}:{port}"),
        ("AWS_ACCESS_KEY_ID", "nobody"),
        ("AWS_SECRET_ACCESS_KEY", "nothing"),
        ("AWS_DEFAULT_REGION", "us-east-1"),
    ):
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    s3fs.S3FileSystem().mkdir("season")
    yield "s3://season"
    s3fs.S3FileSystem.clear_instance_cache()
    serving.stop()


@pytest.mark.ci
def test_a_season_in_a_bucket_becomes_dives_in_a_bucket(
    bucket: str, small_recording: Path, tmp_path: Path, command: Cli
) -> None:
    import s3fs

    system = s3fs.S3FileSystem()
    system.put(str(season(tmp_path / "dives", small_recording, 1)), "season/dives", recursive=True)
    cache = tmp_path / "cache"
    given = (f"{bucket}/dives", "--out", f"{bucket}/site", "--cache", cache, *SHORT, "--json")
    ran = command("lab", "batch", *given)
    assert ran.code in (0, 3), ran.err + ran.out
    manifest = json.loads(system.cat_file("season/site/dives/dive0/manifest.json"))
    found = {path.partition("/dives/dive0/")[2] for path in system.find("season/site/dives")}
    assert found == {*manifest["files"], "manifest.json"}
    assert "season/site/batch.jsonl" in system.ls("season/site")
    assert [path.name for path in cache.iterdir()] == ["batch.jsonl"]
    again = command("lab", "batch", *given)
    assert json.loads(again.out)["dives"]["dive0"]["earlier"]


def test_a_bucket_without_its_package_is_told_with_what_to_install(
    monkeypatch: pytest.MonkeyPatch, command: Cli, tmp_path: Path
) -> None:
    import fsspec

    def missing(*given: object, **more: object) -> None:
        raise ImportError("Install s3fs to access S3")

    monkeypatch.setattr(fsspec.core, "url_to_fs", missing)
    ran = command("lab", "batch", "s3://season/dives", "--out", tmp_path / "site")
    assert ran.code == 1
    assert "pip install 'aquaflow[s3]'" in ran.err
