"""The benchmark: order, rows, failures, table, picture, section of a page; ablation rows."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.base.errors.crash_report import MISUSED
from aquaflow.lab.bench import ablation
from aquaflow.lab.bench.benchmark import benchmark, contenders_of, scenes_of
from aquaflow.lab.bench.job import BenchJob
from aquaflow.lab.bench.picture import pareto_front
from aquaflow.lab.bench.runner import KEYS, Contender, in_process, jobs_for
from aquaflow.lab.bench.scene import BenchmarkScene, scene_at
from aquaflow.lab.bench.summary import ATE_PCT, PSNR, lines_of
from aquaflow.lab.bench.table import BEGIN, END, failures, features, markdown, section, write_readme
from aquaflow.lab.evaluation.water_peers.contract import NAMES
from aquaflow.prior.folder import CARD
from tests.command_line import run_aquaflow

REEF, WALL = BenchmarkScene("reef", "/reef", refine_share=0.1), BenchmarkScene("wall", "/wall")
GOOD = {
    "frames": 10, "tracked": 10, "psnr": 30.0, "ate_pct_sim3": 0.5, "restored_psnr": 20.0,
    "ms_per_frame": {"p50": 80.0, "p95": 120.0, "total": 200.0},
}  # fmt: skip


def quiet(stage: str, done: int, total: int | None) -> None:
    """Progress that nobody looks at."""


def pretended(job: BenchJob) -> dict[str, Any]:
    """Runs that take no time; on the wall they fail."""
    if job.scene.name == "wall":
        return {"failed": "none of 10 frames could be placed."}
    faster = {"fast": 1.0, "balanced": 2.0, "accurate": 4.0}[job.preset]
    better = {"psnr": 30.0 + faster + job.repeat, "ate_pct_sim3": 1.0 / faster}
    total = {"p50": 80.0, "p95": 120.0, "total": 100.0 * faster}
    return {**GOOD, **better, "ms_per_frame": total}


def test_the_pareto_front_holds_what_nothing_beats() -> None:
    cost = [3.0, 1.0, 2.0, 4.0, 2.0, 5.0]
    error = [1.0, 5.0, 3.0, 2.0, 3.0, 1.0]
    assert pareto_front(cost, error) == [1, 2, 0]
    assert pareto_front([], []) == []


@pytest.mark.parametrize("seed", range(5))
def test_the_pareto_front_is_that_of_the_definition(seed: int) -> None:
    points = np.random.default_rng(seed).random((40, 2))
    beaten = [
        any((q <= p).all() and (q < p).any() for q in points) for p in points
    ]  # fmt: skip
    front = pareto_front(points[:, 0].tolist(), points[:, 1].tolist())
    assert set(front) == {i for i, lost in enumerate(beaten) if not lost}


def test_runs_are_interleaved() -> None:
    contenders = [Contender("fast"), Contender("accurate"), Contender("balanced", "two-view")]
    jobs = jobs_for([REEF, WALL], contenders, 2, Path("out"))
    assert len(jobs) == len({job.out for job in jobs}) == 12
    assert [job.repeat for job in jobs] == [0] * 6 + [1] * 6
    first, second = jobs[:3], jobs[3:6]
    assert [job.scene.name for job in first + second] == ["reef"] * 3 + ["wall"] * 3
    assert (first[0].preset, first[0].peer) != (second[0].preset, second[0].peer)


def test_a_job_survives_its_way_to_the_worker_and_makes_its_config() -> None:
    job = BenchJob(REEF, "accurate", "out", overrides={"mapping": {"medium": {"enabled": False}}})
    assert BenchJob.from_text(job.to_text()) == job
    config = job.config()
    assert config.mapping.optimiser.refine_steps == 400
    assert not config.mapping.medium.enabled


def test_a_benchmark_writes_all_its_results_and_marks_failures(tmp_path: Path) -> None:
    contenders = contenders_of(["fast", "balanced", "accurate"], peers=False)
    result = benchmark([REEF, WALL], contenders, 2, tmp_path, quiet, pretended)
    written = json.loads((tmp_path / "bench.json").read_text())
    assert written == json.loads(json.dumps(result))
    assert set(written) == {"machine", "runs"}
    assert len(written["runs"]) == 12
    for row in written["runs"]:
        keys = {"scene", "preset", "peer", "repeat", "load", "failed", *KEYS}
        assert keys <= set(row)
        assert bool(row["failed"]) == (row["scene"] == "wall")
    assert (tmp_path / "bench.png").read_bytes().startswith(b"\x89PNG")
    lines = lines_of(result["runs"])
    assert [line.contender for line in lines[:3]] == ["fast", "balanced", "accurate"]
    assert lines[0].cell(PSNR) == "31.50 ± 0.50"
    assert lines[0].cell(ATE_PCT) == "1.000 ± 0.000"
    assert failures(result["runs"])[0] == (
        "wall, fast: 2 of 2 runs failed: none of 10 frames could be placed."
    )
    assert markdown(result["runs"]).count("failed") == 3


def test_what_a_peer_matched_is_said_below_the_table(tmp_path: Path) -> None:
    def colmap(job: BenchJob) -> dict[str, Any]:
        return pretended(job) | ({"features": "SIFT"} if job.peer else {})

    contenders = [Contender("fast"), Contender("balanced", "colmap")]
    result = benchmark([REEF], contenders, 1, tmp_path, quiet, colmap)
    assert features(result["runs"]) == ["colmap ran with SIFT."]
    assert [row["features"] for row in result["runs"]] == [None, "SIFT"]
    assert "colmap ran with SIFT." in section("x.png", result["machine"], result["runs"])


@pytest.mark.parametrize("name", ["README.md", "notes/2026-11-benchmarks.md", "out/page.md"])
def test_a_page_gets_the_section_between_its_markers(tmp_path: Path, name: str) -> None:
    result = benchmark([REEF], [Contender("fast")], 1, tmp_path / "out", quiet, pretended)
    readme, picture = tmp_path / name, tmp_path / "out" / "bench.png"
    readme.parent.mkdir(exist_ok=True)
    readme.write_text(f"before\n{BEGIN}\nold numbers\n{END}\nafter\n")
    for _ in range(2):
        write_readme(readme, picture, result["machine"], result["runs"])
    assert (readme.parent / "bench.png").read_bytes() == picture.read_bytes()
    text = readme.read_text()
    assert text.startswith(f"before\n{BEGIN}\n")
    assert text.endswith(f"{END}\nafter\n")
    assert "old numbers" not in text
    assert "(bench.png)" in text
    assert re.search(r"\| reef \| fast \| 100 \| 100 ", text)
    assert result["machine"]["date"] in text
    readme.write_text("no markers")
    with pytest.raises(InputError, match="needs the lines"):
        write_readme(readme, picture, result["machine"], result["runs"])


@pytest.mark.ci
def test_a_worker_that_fails_or_crashes_is_a_row(tmp_path: Path) -> None:
    gone = BenchJob(BenchmarkScene("gone", str(tmp_path / "gone")), "fast", str(tmp_path / "dive"))
    assert "there is nothing at" in in_process(gone)["failed"]
    broken = BenchJob(REEF, "no such preset", str(tmp_path / "dive"))
    assert "no preset 'no such preset'" in in_process(broken)["failed"]


def test_what_cannot_be_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="no preset"):
        contenders_of(["slow"], peers=False)
    for suite, data, said in (
        (None, None, "nothing to run"),
        ("real", None, "needs a data folder"),
        ("ic", None, "no suite"),
    ):
        with pytest.raises(ArgumentError, match=said):
            scenes_of(suite, data, [], tmp_path, quiet)


def test_ablation_has_a_row_for_every_part_built_or_not(tmp_path: Path) -> None:
    result = ablation.ablate([REEF], tmp_path, quiet, perform=pretended)
    rows = {row["part"]: row for row in result["rows"]}
    assert len(rows) == len(ablation.PARTS)
    assert result["rows"][0]["part"] == "full"
    for row in rows.values():
        assert {"part", "psnr", "ate_pct", "ms_per_frame", "built"} <= set(row)
        assert (row["psnr"] is not None) == row["built"]
    assert not rows["skip off: retrieval only at keyframes"]["built"]
    for part in ("distance embedding", "an MLP instead of LGPD"):
        assert any(part in name and row["built"] for name, row in rows.items())


def test_rows_are_chosen_by_a_word_of_their_name() -> None:
    chosen = [part.name for part in ablation.parts_called(["joint adjustment", "overlays"])]
    assert chosen == ["full", "without masking of overlays", "without joint adjustment"]
    assert ablation.parts_called([]) == list(ablation.PARTS)
    with pytest.raises(ArgumentError, match="no part is called 'magic'"):
        ablation.parts_called(["overlays", "magic"])


def test_an_oracle_is_written_once_for_each_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written, folders = [], []

    def write(recording: Path, folder: Path, sigma: float, _: object) -> None:
        folder.mkdir(parents=True)
        (folder / CARD).write_text("{}")
        written.append((recording, sigma))

    def noted(job: BenchJob) -> dict[str, object]:
        folders.append(job.config().prior.folder)
        return pretended(job)

    monkeypatch.setattr(ablation, "make_oracle", write)
    parts = [part for part in ablation.PARTS if part.oracle][:2]
    ablation.ablate([REEF], tmp_path, quiet, parts, noted)
    assert written == [(Path(REEF.recording), ablation.ORACLE_SIGMA)]
    assert folders[0] == folders[1]
    assert (folders[0] / CARD).is_file()


def test_every_part_that_is_built_changes_the_config() -> None:
    full = BenchJob(REEF, "balanced", "out").config()
    for part in ablation.PARTS[1:]:
        changed = BenchJob(REEF, "balanced", "out", overrides=part.overrides).config() != full
        assert changed == part.built


def test_an_ablation_with_a_failed_scene_gives_no_mean(tmp_path: Path) -> None:
    parts = ablation.PARTS[:2]
    result = ablation.ablate([REEF, WALL], tmp_path, quiet, parts, pretended)
    assert [row["psnr"] for row in result["rows"]] == [None, None]
    assert "wall: none of 10 frames" in result["rows"][0]["failed"][0]


@pytest.mark.ci
def test_bench_on_a_small_dive(small_recording: Path, tmp_path: Path) -> None:
    out, scene = tmp_path / "bench", scene_at(small_recording)
    few = {"mapping": {"optimiser": {"refine_steps": 20, "heldout_steps": 5}}}

    def briefly(job: BenchJob) -> dict[str, Any]:
        return in_process(BenchJob(job.scene, job.preset, job.out, job.peer, few, job.repeat))

    contenders = [Contender("fast"), Contender("fast", "two-view")]
    ours, peer = benchmark([scene], contenders, 1, out, quiet, briefly)["runs"]
    assert ours["failed"] is None
    assert peer["failed"] is None
    assert ours["ate_pct_sim3"] < 2.0
    assert 0.0 < ours["depth_absrel"] < 0.3
    assert ours["restored_psnr"] > 5.0
    for name in NAMES:
        known = ours[f"restored_psnr_{name}"] is not None
        assert known != (name in ours["restored_peer_reasons"])
        assert peer[f"restored_psnr_{name}"] is None
    assert ours["medium_error"]["attenuation_ratio"]
    assert ours["peak_rss_mb"] > 100.0
    assert ours["time_to_first_pose_s"] < ours["wall_s"]
    assert ours["ms_per_frame"]["p50"] <= ours["ms_per_frame"]["p95"]
    assert peer["psnr"] is None
    assert peer["preset"] is None


def test_the_command_refuses_in_one_sentence() -> None:
    ran = run_aquaflow("lab", "bench", "--suite", "real")
    assert ran.code == MISUSED
    assert ran.err.splitlines() == [
        "aquaflow: --suite real needs a data folder: aquaflow lab bench --suite real DATA_DIR"
    ]
