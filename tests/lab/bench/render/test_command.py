"""``aquaflow lab bench render`` as a whole: contenders, peers, failures, files, command line."""

from __future__ import annotations

import io
import json
from functools import partial
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from aquaflow.base.errors.crash_report import MISUSED
from aquaflow.cli import app
from aquaflow.lab.bench.render import benchmark as bm
from aquaflow.lab.bench.render import peak as peaks
from aquaflow.lab.bench.render import table as sizes
from aquaflow.lab.bench.render.contenders import (
    Timed,
    contenders_here,
    thread_counts,
)
from aquaflow.lab.bench.render.parts import parts_of
from aquaflow.lab.bench.render.table import SIZES, print_result
from aquaflow.render.example_scene import NAMES, SMALL, Size
from aquaflow.render.native.build import supported_isas
from tests.command_line import refused, run_aquaflow
from tests.lab.bench.render.pretended_renderer import PEAK, TINY, Pretended, SlowedClock


def quiet(stage: str, done: int, total: int | None) -> None:
    """Progress that nobody looks at."""


def test_everything_that_runs_here_is_a_contender() -> None:
    found, notes = contenders_here()
    kinds = {(c.name, c.isa, c.threads) for c in found}
    counts = thread_counts()
    assert {("cpu", isa, count) for isa in supported_isas() for count in counts} <= kinds
    assert {("tiles", "torch", count) for count in counts} <= kinds
    assert ("reference", "torch", 1) in kinds
    assert any(c.name == "gsplat" for c in found) != any("gsplat" in note for note in notes)
    largest = max(SIZES, key=lambda size: size.n * size.pixels)
    assert {c.name for c in found if c.takes(largest)} <= {"cpu", "gsplat"}
    assert all(c.takes(SMALL) for c in found)


def test_a_renderer_that_fails_costs_only_its_own_row() -> None:
    full = Timed(Pretended(SlowedClock(), fails_after=0))
    time, notes = SlowedClock(), list[str]()
    good = Timed(Pretended(time), clock=time.clock())
    rows = bm.time_sizes([full, good], [TINY], 2, PEAK, notes, quiet)
    assert [(row["renderer"], row["n"], row["repeats"]) for row in rows] == [("pretended", 200, 2)]
    assert notes == ["pretended (none) failed at 400, 96 x 72: no room"]


def test_a_renderer_that_fails_between_its_repeats_has_no_row() -> None:
    time, notes = SlowedClock(), list[str]()
    tiring = Timed(Pretended(time, fails_after=3), clock=time.clock())  # two of them uncounted
    assert bm.time_sizes([tiring], [TINY], 2, PEAK, notes, quiet) == []
    assert notes == ["pretended (none) failed at 200, 52 x 39: no room"]


@pytest.fixture
def small_benchmark(monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole command in seconds."""
    monkeypatch.setattr(peaks, "STEPS", 20_000)
    monkeypatch.setattr(sizes, "QUICK_SIZES", (TINY, Size(400, 52, 39)))
    monkeypatch.setattr(bm, "parts_of", partial(parts_of, pictures=[(32, 24)], rows=[50]))


@pytest.mark.usefixtures("small_benchmark")
@pytest.mark.ci
def test_the_benchmark_writes_rows_gradients_and_a_picture(tmp_path: Path) -> None:
    arguments = [
        "lab",
        "bench",
        "render",
        "--quick",
        "--repeats",
        "2",
        "--json",
        "--out",
        str(tmp_path),
    ]
    ran = CliRunner().invoke(app, arguments)
    assert ran.exit_code == 0, ran.output
    written = json.loads((tmp_path / bm.JSON_FILE).read_text())
    assert json.loads(ran.stdout) == written
    keys = {"renderer", "isa", "threads", "n", "width", "height", "fwd_ms", "bwd_ms", "stage_ms"}
    assert all(keys <= set(row) for row in written["rows"])
    fastest = [row for row in written["rows"] if row["isa"] == supported_isas()[0]]
    assert len(fastest) == 3 * len(thread_counts())  # and the small scene
    assert all(row["share_of_peak"]["both"] > 0.0 for row in fastest)
    assert all(row["share_of_blend_limit"]["both"] > 0.0 for row in fastest)
    assert set(written["machine"]["blend_limit"]) == set(supported_isas())
    assert set(written["gradient_rel_error"]) == set(NAMES)
    assert 0.0 < max(written["gradient_rel_error"].values()) <= 5e-5
    assert {"processor", "load", "peak_gflop_per_s", "peak_method"} <= set(written["machine"])
    assert (tmp_path / bm.PICTURE_FILE).read_bytes().startswith(b"\x89PNG")
    page = io.StringIO()
    print_result(written, Console(file=page, width=200))
    shown = page.getvalue()
    for name in (*supported_isas(), "reference", "L1 + SSIM", "GFLOP/s", "means"):
        assert name in shown


# --- the command line -----------------------------------------------------------------------------


@pytest.mark.parametrize("order", [("--suite", "real", "DATA"), ("DATA", "--suite", "real")])
def test_bench_still_takes_a_suite_and_a_folder_in_any_order(
    tmp_path: Path, order: tuple[str, ...]
) -> None:
    refused(
        run_aquaflow("lab", "bench", *(tmp_path if word == "DATA" else word for word in order)),
        tmp_path,
    )


def test_what_is_neither_a_command_nor_a_suite_is_refused() -> None:
    refused(run_aquaflow("lab", "bench", "rendr"), "rendr", "render", code=MISUSED)
    refused(run_aquaflow("lab", "bench"), "nothing to run", code=MISUSED)


def test_bench_render_refuses_in_one_sentence(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("x")
    refused(run_aquaflow("lab", "bench", "render", "--out", file), file)


@pytest.mark.parametrize(
    ("arguments", "shown"),
    [
        (("lab", "bench", "--help"), "--suite"),
        (("lab", "bench", "render", "--help"), "--repeats"),
    ],
)
def test_both_commands_explain_themselves(arguments: tuple[str, ...], shown: str) -> None:
    ran = CliRunner().invoke(app, arguments)
    assert ran.exit_code == 0
    assert shown in ran.output
    assert "bench render" in ran.output


@pytest.mark.parametrize("option", [("--repeats", "0"), ("--sizes", "3"), ("extra",)])
def test_wrong_options_of_bench_render_are_usage_errors(option: tuple[str, ...]) -> None:
    ran = CliRunner().invoke(app, ["lab", "bench", "render", *option])
    assert ran.exit_code == 2
    assert option[0] in ran.output
