"""``aquaflow lab bench growth``: jobs, one real survey, table, picture, failures, command line."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.base.storage.archive import write_facts_file
from aquaflow.cli import app
from aquaflow.geometry.arrays import add_prefix
from aquaflow.lab.bench.growth import benchmark as bm
from aquaflow.lab.bench.growth import worker
from aquaflow.lab.bench.growth.benchmark import COLUMNS, markdown
from aquaflow.lab.bench.growth.job import ABOARD, GrowthJob
from aquaflow.lab.bench.growth.worker import checkpoint_bytes, folder_bytes
from aquaflow.live.checkpoint import tracking
from aquaflow.mapping.maps import Maps
from aquaflow.slam import Slam

FRAMES = 60
PARTS = ("tracking_ms", "mapping_ms", "graph_ms")


def quiet(stage: str, done: int, total: int | None) -> None:
    """Progress that nobody looks at."""


def pretended(job: GrowthJob) -> dict[str, Any]:
    """A survey that takes no time; the longest fails."""
    if job.frames == 900:
        return {"failed": "none of 900 frames could be placed"}
    tenths = [
        {
            "frames": job.frames * (i + 1) // 10, "tracking_ms": 20.0, "mapping_ms": 50.0 + i,
            "graph_ms": 5.0, "keyframes": i, "gaussians": 1000 * i, "resident_mb": 400.0 + i,
        }
        for i in range(10)
    ]  # fmt: skip
    return {
        "tenths": tenths, "keyframes": 9, "loops": 1, "gaussians": 9000, "start_mb": 300.0,
        "end_mb": 409.0, "peak_mb": None, "dive_bytes": 3_000_000, "checkpoint_bytes": 600_000,
        "finish_cpu_s": 12.3, "viewer": None if job.tracking_only else {"page_s": 1, "map_s": 2},
    }  # fmt: skip


def test_surveys_run_from_the_shortest_on_each_once(tmp_path: Path) -> None:
    jobs = bm.jobs_of([300, 100, 300], 160, "fast", False, tmp_path)
    assert [job.frames for job in jobs] == [100, 300]
    assert len({job.out for job in jobs}) == 2
    config = jobs[0].config()
    assert (config.threads, config.mapping.enabled) == (1, True)
    assert config.mapping.max_gaussians == 80_000
    assert GrowthJob.from_text(jobs[1].to_text()) == jobs[1]


def test_a_survey_without_a_map_is_tracked_only(tmp_path: Path) -> None:
    (job,) = bm.jobs_of([100], 160, "balanced", True, tmp_path)
    assert not job.config().mapping.enabled


def test_a_survey_of_the_hour_with_instruments_and_settings_is_a_job(tmp_path: Path) -> None:
    settings = tmp_path / "settings.yaml"
    settings.write_text("mapping: {hold_out_every: 5}\n")
    (job,) = bm.jobs_of([100], 160, "fast", False, tmp_path, "hour", "dvl", settings)
    assert (job.scene, job.telemetry) == ("hour", "dvl")
    config = GrowthJob.from_text(job.to_text()).config()
    assert config.mapping.hold_out_every == 5
    assert config.mapping.max_gaussians == 80_000
    assert ABOARD["attitude"] == ("depth", "attitude")


@pytest.mark.parametrize("option", ["--scene", "--telemetry"])
def test_an_unknown_scene_or_instrument_is_refused(option: str, tmp_path: Path) -> None:
    asked = ["lab", "bench", "growth", "--quick", option, "sonar", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, asked)
    assert result.exit_code != 0
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_run_is_refused_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="--frames 10 is too short"):
        bm.jobs_of([1000, 10], 160, "fast", False, tmp_path)
    with pytest.raises(ArgumentError, match="no preset 'faster'"):
        bm.jobs_of([1000], 160, "faster", False, tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="give another --out"):
        bm.bench_growth([], tmp_path / "file", quiet)


@pytest.mark.parametrize("tracking_only", [False, True])
def test_a_table_a_picture_and_all_numbers_are_written(tmp_path: Path, tracking_only: bool) -> None:
    jobs = bm.jobs_of([100, 900], 160, "fast", tracking_only, tmp_path)
    result = bm.bench_growth(jobs, tmp_path, quiet, pretended)
    assert json.loads((tmp_path / bm.JSON_FILE).read_text()) == result
    assert (tmp_path / bm.PICTURE_FILE).stat().st_size > 10_000
    caption, _, table = (tmp_path / bm.TABLE_FILE).read_text().partition("\n\n")
    assert "160 px" in caption
    assert ("tracking only" in caption) == tracking_only
    assert table == markdown(result["rows"])


def test_a_line_has_first_and_last_tenth_memory_and_bytes_per_1000_frames(tmp_path: Path) -> None:
    jobs = bm.jobs_of([500, 900], 160, "fast", False, tmp_path)
    lines = markdown(bm.bench_growth(jobs, tmp_path, quiet, pretended)["rows"]).splitlines()
    cells = [cell.strip() for cell in lines[2].strip("|").split("|")]
    assert dict(zip(COLUMNS, cells, strict=True)) == {
        "frames": "500", "tracking": "20.0, 20.0", "mapping": "50.0, 59.0", "graph": "5.0, 5.0",
        "keyframes": "9", "Gaussians": "9000", "MB resident": "300, 409, -",
        "dive, MB per 1000": "6.0", "checkpoint, MB per 1000": "1.2", "end, CPU s": "12",
        "viewer, s": "1.0, 2.0",
    }  # fmt: skip
    assert "none of 900 frames could be placed" in lines[3]
    assert lines[3].count("|") == lines[2].count("|")


@pytest.mark.slow
def test_a_survey_is_mapped_and_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[tuple[int, int]] = []

    def compared(slam: Slam, scratch: Path) -> int:
        """Also as large as the checkpoint that a live dive would write."""
        stands_for = SimpleNamespace(first_pose_s=None, notes=[])
        told = tracking.serialise(slam, stands_for)  # type: ignore[arg-type]
        assert told is not None
        assert isinstance(slam.maps, Maps)
        facts, arrays = slam.maps.serialise()
        whole = add_prefix("tracking", told[1]) | add_prefix("mapping", arrays)
        write_facts_file(tmp_path / "true.npz", {"tracking": told[0], "mapping": facts}, whole)
        sizes.append(
            (checkpoint_bytes(slam, scratch), (tmp_path / "true.npz").stat().st_size)
        )  # fmt: skip
        assert not scratch.exists()
        return sizes[-1][0]

    monkeypatch.setattr(worker, "checkpoint_bytes", compared)
    row = worker.perform(GrowthJob(FRAMES, 96, str(tmp_path / "dive"), "fast"))
    assert sizes[0][0] == pytest.approx(sizes[0][1], rel=0.02)
    assert [each["frames"] for each in row["tenths"]] == [6 * (i + 1) for i in range(10)]
    assert all(sum(each[part] for each in row["tenths"]) > 0.0 for part in PARTS)
    kept = (tmp_path / "dive" / worker.TENTHS_FILE).read_text().splitlines()
    assert [json.loads(line) for line in kept] == row["tenths"]
    assert row["tenths"][0]["ate_sub_maps_pct"] is None, "no frame has a pose yet"
    assert row["tenths"][-1]["ate_sub_maps_pct"] == pytest.approx(row["ate_sub_maps_pct"], abs=1.0)
    assert row["tracked"] > 0.9 * FRAMES
    assert 0.0 < row["viewer"]["page_s"] < row["viewer"]["map_s"]
    # Other tests ran in this process: what they left free is used before more is asked for.
    assert 0.0 < row["start_mb"] <= row["peak_mb"]
    assert 0.0 < row["end_mb"] <= row["peak_mb"]
    assert row["dive_bytes"] > 0
    assert row["finished_bytes"] == folder_bytes(tmp_path / "dive")
    assert not (tmp_path / "dive" / "work").exists()


def test_the_command_prints_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bm, "_in_process", pretended)
    asked = ["lab", "bench", "growth", "--quick", "--preset", "fast", "--out", str(tmp_path)]
    said = CliRunner().invoke(app, asked).stdout
    assert "| 150 |" in said
    assert "| 300 |" in said
    assert str(tmp_path / bm.PICTURE_FILE) in said
    result = json.loads(CliRunner().invoke(app, [*asked, "--frames", "100", "--json"]).stdout)
    assert [row["frames"] for row in result["rows"]] == [100]
