"""``render_bench.json`` as tables for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from aquaflow.lab.bench.render.interactions import BACKWARD_FLOP, FORWARD_FLOP
from aquaflow.lab.bench.render.rows import Row
from aquaflow.lab.bench.summary import Spread
from aquaflow.render.example_scene import Size

UNKNOWN = "-"
"""Printed where there is no number."""
ON_GPU = (("GPU ms fwd", "fwd_gpu_ms"), ("GPU ms bwd", "bwd_gpu_ms"), ("GPU MB", "gpu_mb"))
"""Columns that are there if something was drawn on a GPU, and their keys."""


def print_result(result: dict[str, Any], console: Console) -> None:
    """Renderers, parts, gradients, then how to read it all."""
    console.print(renderer_table(result["rows"]))
    console.print()
    console.print(part_table(result["parts"]))
    console.print()
    for sentence in sentences(result):
        console.print(sentence, highlight=False, markup=False)


def renderer_table(rows: Sequence[Row]) -> Table:
    """One line for each contender and size; columns for stages where a renderer reports them."""
    stages = list(dict.fromkeys(name for row in rows for name in row["stage_ms"] or ()))
    gpu = [title for title, key in ON_GPU if any(row[key] is not None for row in rows)]
    table = _table(("picture", "Gaussians", "renderer", "threads"))
    for title in (
        "forward ms", "backward ms", "both ms", "CPU ms", *gpu, "G/s fwd", "G/s bwd",
        "peak % fwd", "bwd", "both", "limit % both", *stages,
    ):  # fmt: skip
        table.add_column(title, justify="right", no_wrap=True)
    before: tuple[str, int] | None = None
    for row in rows:
        size = f"{row['width']} x {row['height']}", row["n"]
        if before not in (None, size):
            table.add_section()
        shown, before = (("", "") if size == before else (size[0], str(size[1]))), size
        name = f"{row['renderer']}, {row['isa']}"
        table.add_row(*shown, name, str(row["threads"]), *_cells(row, gpu, stages))
    return table


def _cells(row: Row, gpu: Sequence[str], stages: Sequence[str]) -> list[str]:
    cpu = row["fwd_cpu_ms"], row["bwd_cpu_ms"]
    shares, stage_ms = row["share_of_peak"] or {}, row["stage_ms"] or {}
    return [
        _ms(row, "fwd"),
        _ms(row, "bwd"),
        _number(row["fwd_ms"] + row["bwd_ms"], ".2f"),
        _number(None if None in cpu else sum(cpu), ".2f"),
        *(_number(row[key], ".2f") for title, key in ON_GPU if title in gpu),
        *(_number(row[f"{key}_interactions_per_s"], ".3f", 1e-9) for key in ("fwd", "bwd")),
        *(_number(shares.get(key), ".1f", 100.0) for key in ("fwd", "bwd", "both")),
        _number((row["share_of_blend_limit"] or {}).get("both"), ".1f", 100.0),
        *(_number(stage_ms.get(stage), ".2f") for stage in stages),
    ]


def _ms(row: Row, key: str) -> str:
    return Spread(row[f"{key}_ms"], row[f"{key}_ms_half_range"], row["repeats"]).text(".2f")


def _number(value: float | None, form: str, factor: float = 1.0) -> str:
    return UNKNOWN if value is None else format(factor * value, form)


def part_table(parts: Sequence[Row]) -> Table:
    """Loss and optimiser."""
    table = _table(("part", "work", "variant", "threads"))
    table.add_column("ms", justify="right", no_wrap=True)
    table.add_column("CPU ms", justify="right", no_wrap=True)
    for row in sorted(parts, key=lambda row: (row["part"], row["threads"])):
        spread = Spread(row["ms"], row["ms_half_range"], row["repeats"]).text(".2f")
        cells = (row["part"], row["work"], row["variant"], str(row["threads"]), spread)
        table.add_row(*cells, _number(row["cpu_ms"], ".2f"))
    return table


def _table(titles: Sequence[str]) -> Table:
    table = Table(show_edge=False, pad_edge=False)
    for title in titles:
        table.add_column(title, no_wrap=True)
    return table


def sentences(result: dict[str, Any]) -> list[str]:
    """Accuracy, what the numbers mean, the machine, and what is missing."""
    machine, errors = result["machine"], result["gradient_rel_error"]
    peaks = ", ".join(
        f"{rate:.0f} GFLOP/s with {count} thread{'' if count == '1' else 's'}"
        for count, rate in machine["peak_gflop_per_s"].items()
    )
    said = [
        "Medians ± half the range of interleaved repeats, on the wall; slow renderers run once. "
        "CPU ms is the thread's own time, forward and backward, which other programs do not "
        "lengthen.",
        "G/s: 1e9 interactions/s, an interaction being a pixel and a Gaussian that contributes to "
        "it (alpha above 1/255, transmittance above 1e-4); by the GPU's time, by CPU time with one "
        "thread, else by the wall's.",
        f"Machine: {machine['processor']}, {machine['cores']} cores, load {machine['load']} at "
        f"the start; {machine['date']}.",
    ]
    if peaks:
        said.append(
            f"Share of peak: {FORWARD_FLOP:.0f} operations an interaction forward, "
            f"{BACKWARD_FLOP:.0f} backward; what is computed in vain is not counted as work. "
            f"Peak: {peaks}, by {machine['peak_method']}."
        )
    if machine["blend_limit"]:
        limits = "; ".join(
            f"{isa} {1e-9 * limit['fwd']:.2f} and {1e-9 * limit['bwd']:.2f}"
            for isa, limit in machine["blend_limit"].items()
        )
        said.append(
            "Share of the limit: of the 1e9 interactions/s that one thread blends forward and "
            f"backward where Gaussians reach every pixel of a picture in the caches: {limits}. "
            "Projecting, sorting and lanes in vain count against it."
        )
    if machine["gpu"]:
        said.append(
            f"GPU: {machine['gpu']}. GPU ms is between events in its own stream of work, GPU MB "
            "the most that torch held there. No peak of it was measured, so no share is stated."
        )
    if errors:
        each = ", ".join(f"{name} {error:.1e}" for name, error in errors.items())
        said.append(f"Relative gradient error against the float64 reference, worst kernel: {each}.")
    if not any(row["stage_ms"] for row in result["rows"]):
        said.append("No stages: none of these renderers reports the time of its stages.")
    return [*said, *result["notes"]]


# --------------------------------------------------------------------------------------------------
# The sizes of the scenes that `aquaflow lab bench render` draws.

COUNTS = (10_000, 30_000, 100_000, 300_000)
PICTURES = ((320, 240), (640, 480), (1280, 720))
SIZES = tuple(Size(n, *picture) for picture in PICTURES for n in COUNTS)
"""Numbers of Gaussians, sizes of pictures, and each with each."""
QUICK_SIZES = (Size(30_000, 320, 240), Size(100_000, 640, 480))
"""Those of the renderer's bars."""
