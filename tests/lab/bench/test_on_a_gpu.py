"""`aquaflow lab bench --device cuda` and `bench render --device cuda`, on a pretended device."""

from __future__ import annotations

import io
import json
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from rich.console import Console
from typer.testing import CliRunner

from aquaflow.base.errors import AquaFlowError, NotMappedError
from aquaflow.base.errors.crash_report import MISUSED
from aquaflow.cli import app
from aquaflow.config.presets import FOR_A_GPU
from aquaflow.lab.bench import machine, meter, worker
from aquaflow.lab.bench.benchmark import benchmark, contenders_of
from aquaflow.lab.bench.job import BenchJob
from aquaflow.lab.bench.meter import OnCuda, meter_of, require
from aquaflow.lab.bench.render import benchmark as bm
from aquaflow.lab.bench.render import contenders, timing
from aquaflow.lab.bench.render import table as sizes
from aquaflow.lab.bench.render.contenders import Timed
from aquaflow.lab.bench.render.parts import parts_of
from aquaflow.lab.bench.render.rows import row_of
from aquaflow.lab.bench.render.table import print_result
from aquaflow.lab.bench.scene import BenchmarkScene, scene_at
from aquaflow.lab.bench.table import markdown, section
from aquaflow.render import gsplat
from aquaflow.render.contract import CPU
from aquaflow.render.example_scene import Size, height_field
from aquaflow.render.gsplat import Gpu
from aquaflow.render.webgpu_device import missing
from tests.command_line import Cli, refused
from tests.device.device_scenes import SinglePrecision, without_kernels
from tests.lab.bench.render.pretended_renderer import PEAK, TINY, Pretended, SlowedClock
from tests.pretended_device import PRETENDED, pretended_device

ORIN = Gpu("Orin", "8.7", 7.4, "2.8.0", "12.6", ("sm_87",))
NAMED = "Orin, compute capability 8.7, 7.4 GB, torch 2.8.0 with CUDA 12.6"


SMALLEST = Size(60, 40, 30)


def quiet(stage: str, done: int, total: int | None) -> None:
    """Progress that nobody looks at."""


class Counting(meter.OnCpu):
    """A meter whose device takes 2 ms from one mark to the next, and 12.5 MB."""

    def __init__(self) -> None:
        self.marks = self.waits = 0

    def settle(self) -> None:
        self.waits += 1

    def mark(self) -> int:  # type: ignore[override]
        self.marks += 1
        return self.marks

    def between_ms(self, first: int, second: int) -> float:  # type: ignore[override]
        return 2.0 * (second - first)

    def peak_mb(self) -> float:  # type: ignore[override]
        return 12.5


class Gsplat(SinglePrecision):
    """The reference in gsplat's place, on the pretended device."""

    name, isa = "gsplat", "cuda"

    def __init__(self) -> None:
        super().__init__(PRETENDED)


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Counting:
    """A machine that says it has a GPU; what runs on it runs on the pretended device."""
    counting = Counting()

    def found(device: torch.device) -> meter.Meter:
        return meter.OnCpu() if device == CPU else counting

    for module in (meter, timing):
        monkeypatch.setattr(module, "meter_of", found)
    monkeypatch.setattr(contenders, "GsplatRenderer", Gsplat)
    monkeypatch.setattr(bm, "require", lambda device: None)
    monkeypatch.setattr(machine, "_gpu", lambda: str(ORIN))
    return counting


# --- the renderer's table -----------------------------------------------------------------------


def test_the_renderers_table_comes_out_on_a_device(
    gpu: Counting, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sizes, "QUICK_SIZES", (TINY,))
    monkeypatch.setattr(bm, "SMALL", SMALLEST)
    monkeypatch.setattr(bm, "parts_of", partial(parts_of, pictures=[(32, 24)], rows=[50]))
    arguments = [
        "lab",
        "bench",
        "render",
        "--quick",
        "--repeats",
        "2",
        "--device",
        "cuda",
        "--json",
    ]
    with pretended_device() as device:
        ran = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path)])
        assert device.calls > 0
    assert ran.exit_code == 0, ran.output
    result = json.loads(ran.stdout)
    rows = result["rows"]
    assert {(row["renderer"], row["isa"]) for row in rows} == {
        ("gsplat", "cuda"), ("reference", "torch"),
    }  # fmt: skip
    assert [row["n"] for row in rows if row["renderer"] == "gsplat"] == [SMALLEST.n, TINY.n]
    on_cpu = row_of(
        Timed(Pretended(SlowedClock())), TINY, [timing.Sample(1.0, 2.0)], 100, PEAK, None
    )
    for row in rows:
        assert set(row) == set(on_cpu)
        assert (row["fwd_gpu_ms"], row["bwd_gpu_ms"], row["gpu_mb"]) == (2.0, 2.0, 12.5)
        assert row["fwd_interactions_per_s"] == pytest.approx(row["interactions"] / 2e-3)
        assert row["share_of_peak"] is None
    assert {part["variant"] for part in result["parts"]} >= {"torch", "selective, 30% seen"}
    assert {part["threads"] for part in result["parts"]} == {1}
    assert 0.0 < max(result["gradient_rel_error"].values()) < 1e-6
    assert result["machine"]["gpu"] == NAMED
    assert result["machine"]["peak_gflop_per_s"] == {}
    page = io.StringIO()
    print_result(result, Console(file=page, width=250))
    assert "GPU ms fwd" in page.getvalue()
    assert NAMED in page.getvalue()
    assert "Share of peak" not in page.getvalue()


def test_a_table_without_a_gpu_has_no_columns_for_one(tmp_path: Path) -> None:
    row = row_of(Timed(Pretended(SlowedClock())), TINY, [timing.Sample(1.0, 2.0)], 100, PEAK, None)
    page = io.StringIO()
    peak = {"peak_gflop_per_s": {"1": 1.0}, "peak_method": "nothing", "blend_limit": {}}
    described = {**machine.describe(), **peak}
    result = {
        "machine": described,
        "rows": [row],
        "parts": [],
        "gradient_rel_error": {},
        "notes": [],
    }
    print_result(result, Console(file=page, width=250))
    assert "GPU ms" not in page.getvalue()
    assert "GPU MB" not in page.getvalue()
    assert "Share of peak" in page.getvalue()


def test_a_device_is_waited_for_before_the_wall_clock_is_read(gpu: Counting) -> None:
    time = SlowedClock()
    renderer = Pretended(time, device=CPU)
    waited: list[tuple[int, float]] = []

    class Waiting(Counting):
        def settle(self) -> None:
            super().settle()
            waited.append((self.marks, time.now))

    sample = timing.time_renderer(renderer, height_field(TINY), time.clock(), Waiting())
    assert [marks for marks, _ in waited] == [0, 2, 4]
    assert [now for _, now in waited] == pytest.approx([0.0, 0.010, 0.040])
    assert (sample.fwd_ms, sample.bwd_ms) == pytest.approx((10.0, 30.0))
    assert (sample.fwd_gpu_ms, sample.bwd_gpu_ms, sample.gpu_mb) == (2.0, 2.0, 12.5)


# --- the table of dives -------------------------------------------------------------------------

FEW = {
    "source": {"stop": 8, "width": 64},
    "mapping": {
        "max_gaussians": 1000,
        "insertion": {"density": 0.05},
        "optimiser": {
            "steps_keyframe": 1,
            "steps_mapping": 1,
            "steps_common": 1,
            "refine_steps": 2,
            "heldout_steps": 1,
        },
        "medium": {"fit": False},
    },
}
"""Of a dive that the dense reference can draw."""


@pytest.mark.slow
def test_a_dive_on_a_device_is_the_row_that_one_on_the_cpu_is(
    gpu: Counting, small_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_kernels(monkeypatch)
    scene = scene_at(small_recording)
    job = BenchJob(scene, "fast", str(tmp_path / "dive"), overrides=FEW, device="cuda")
    assert job.config().mapping.renderer == "gsplat"
    assert job.config().prior.device == "cuda"
    rows = {}
    for where in (CPU, PRETENDED):
        renderer = SinglePrecision(where)
        monkeypatch.setattr("aquaflow.render.select_renderer", lambda *_, r=renderer: r)
        on = BenchJob(
            scene, "fast", job.out, overrides=FEW, device="cuda" if where != CPU else None
        )
        with pretended_device():
            rows[where] = worker.perform(on)
    assert rows[PRETENDED].keys() == rows[CPU].keys()
    assert (rows[PRETENDED]["gpu_mb"], rows[CPU]["gpu_mb"]) == (12.5, None)
    assert gpu.waits > 8 * 5  # at the end of every stage
    assert rows[PRETENDED]["device"] == PRETENDED.type
    assert rows[PRETENDED]["gaussians"] == rows[CPU]["gaussians"] > 0
    assert rows[PRETENDED]["psnr"] == pytest.approx(rows[CPU]["psnr"], abs=0.01)
    assert rows[PRETENDED]["ate_pct_sim3"] == rows[CPU]["ate_pct_sim3"]


def test_a_run_that_went_on_on_the_cpu_has_failed(
    gpu: Counting, small_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finished = SimpleNamespace(metrics={"device": "cpu", "gaussians": 100})
    monkeypatch.setattr("aquaflow.dive.replay.map_recording", lambda *_, **__: finished)
    job = BenchJob(scene_at(small_recording), "fast", str(tmp_path), device="cuda")
    with pytest.raises(NotMappedError, match="the GPU failed, and the map went on on the CPU"):
        worker.perform(job)


def test_the_gpu_is_named_and_its_memory_is_a_column(
    gpu: Counting, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    devices = []

    def pretended(job: BenchJob) -> dict[str, Any]:
        devices.append(job.device)
        return {
            "frames": 10,
            "tracked": 10,
            "gpu_mb": None if job.peer else 512.0,
            "ms_per_frame": {"p50": 8.0, "p95": 12.0, "total": 20.0},
        }

    runs = contenders_of(["fast"], peers=True)
    scene = BenchmarkScene("reef", "/reef")
    result = benchmark([scene], runs, 1, tmp_path, quiet, pretended, device="cuda")
    assert devices == ["cuda"] * 3
    assert result["machine"]["gpu"] == NAMED
    assert "gsplat" in result["machine"]["packages"]
    assert "GPU MB" in markdown(result["runs"])
    assert f"GPU: {NAMED}." in section("x.png", result["machine"], result["runs"])
    without = benchmark([scene], runs, 1, tmp_path, quiet, lambda job: {"frames": 1, "tracked": 1})
    assert without["machine"]["gpu"] is None
    assert "gsplat" not in without["machine"]["packages"]
    assert "GPU MB" not in markdown(without["runs"])


# --- what is refused ----------------------------------------------------------------------------


def here(monkeypatch: pytest.MonkeyPatch, found: Gpu | str, missing: str | None) -> None:
    monkeypatch.setattr(meter, "gpu_here", lambda: found)
    monkeypatch.setattr(gsplat, "missing", lambda: missing)


def test_a_device_that_is_not_there_is_refused_with_the_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    here(monkeypatch, "torch 2.13.0+cpu is a build for the processor", None)
    with pytest.raises(AquaFlowError) as refusal:
        require("cuda")
    assert str(refusal.value) == (
        "--device cuda: torch 2.13.0+cpu is a build for the processor; use --device cpu"
    )
    here(monkeypatch, ORIN, "Renderer gsplat is not installed; run pip.")
    with pytest.raises(AquaFlowError, match="--device cuda: Renderer gsplat is not installed"):
        require("cuda")


def test_what_is_there_or_is_not_asked_for_is_not_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    here(monkeypatch, ORIN, None)
    require("cuda")
    here(monkeypatch, "none", "none")
    require("cpu")
    require(None)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
@pytest.mark.parametrize("words", [("lab", "bench", "--suite", "ci"), ("lab", "bench", "render")])
def test_both_commands_refuse_in_one_sentence_and_write_nothing(
    command: Cli, tmp_path: Path, words: tuple[str, ...]
) -> None:
    out = tmp_path / "out"
    refused(command(*words, "--device", "cuda", "--out", out), "--device cuda", "--device cpu")
    refused(command(*words, "--device", "gpu", "--out", out), "use one of cpu, cuda", code=MISUSED)
    assert not out.exists()


# --- the commands -------------------------------------------------------------------------------


def test_on_a_gpu_its_presets_run_too(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from aquaflow.lab.bench import benchmark as dives

    asked = []

    def noted(scenes: Any, runs: Any, *_: Any, device: str | None) -> dict[str, Any]:
        asked.append(([run.preset for run in runs], device))
        return {"machine": {"gpu": None}, "runs": []}

    monkeypatch.setattr(meter, "require", lambda device: None)
    monkeypatch.setattr(dives, "scenes_of", lambda *_: [])
    monkeypatch.setattr(dives, "benchmark", noted)
    for device in ("cuda", "cpu"):
        arguments = ["lab", "bench", "--no-peers", "--device", device, "--out", str(tmp_path)]
        assert CliRunner().invoke(app, arguments).exit_code == 0
    (on_gpu, cuda), (on_cpu, cpu) = asked
    assert (cuda, cpu) == ("cuda", "cpu")
    assert set(on_gpu) - set(on_cpu) == set(FOR_A_GPU)


def test_on_the_cpu_alone_no_gpu_is_a_contender(gpu: Counting) -> None:
    everything, _ = contenders.contenders_here()
    alone, _ = contenders.contenders_here(device="cpu")
    gpus = {"gsplat"} if missing() else {"gsplat", "wgpu"}
    assert {c.name for c in everything} - {c.name for c in alone} == gpus


# --- CUDA's own clock ---------------------------------------------------------------------------


def test_a_cuda_device_is_timed_by_events_and_its_memory_by_torch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[str] = []

    class Event:
        def __init__(self, enable_timing: bool) -> None:
            assert enable_timing

        def record(self) -> None:
            calls.append("record")

        def elapsed_time(self, end: Event) -> float:
            return 3.5

    monkeypatch.setattr(torch.cuda, "Event", Event)
    for name in ("synchronize", "reset_peak_memory_stats"):
        monkeypatch.setattr(torch.cuda, name, lambda name=name: calls.append(name))
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda: 12_540_000)
    cuda = meter_of(torch.device("cuda"))
    assert isinstance(cuda, OnCuda)
    assert isinstance(meter_of(CPU), meter.OnCpu)
    cuda.forget_peak()
    first, second = cuda.mark(), cuda.mark()
    cuda.settle()
    assert calls == ["reset_peak_memory_stats", "record", "record", "synchronize"]
    assert cuda.between_ms(first, second) == 3.5
    assert cuda.peak_mb() == 12.5
