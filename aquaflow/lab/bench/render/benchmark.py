"""``aquaflow lab bench render``: contenders times sizes, and what is written about them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.base.storage.atomic import write_json
from aquaflow.lab.bench import machine
from aquaflow.lab.bench.meter import require
from aquaflow.lab.bench.render.contenders import (
    Timed,
    contenders_here,
    measure_blend_limit,
    thread_counts,
)
from aquaflow.lab.bench.render.interactions import count_interactions
from aquaflow.lab.bench.render.parts import TimedPart, parts_of, time_parts
from aquaflow.lab.bench.render.peak import PeakRate, measure_peak
from aquaflow.lab.bench.render.picture import draw
from aquaflow.lab.bench.render.rows import Row, row_of
from aquaflow.lab.bench.render.timing import Sample, interleave
from aquaflow.render.contract import CPU, Renderer
from aquaflow.render.example_scene import NAMES, SMALL, Size, SplatScene, height_field
from aquaflow.render.reference import differences

JSON_FILE, PICTURE_FILE = "render_bench.json", "render_bench.png"
"""What a benchmark writes."""

FAILURES = (AquaFlowError, MemoryError, RuntimeError, ImportError)
"""Errors that drop one contender's row at a size and no other row; torch and gsplat raise
RuntimeError when the device is full or a kernel does not compile."""

KERNELS = ("cpu", "gsplat")
"""Renderers whose gradients are held against the reference's."""
NO_PEAK = PeakRate({}, "no measurement")
"""Of a GPU: what it could do at most is not estimated."""

Progress = Callable[[str, int, int | None], None]


def bench_render(
    sizes: Sequence[Size],
    repeats: int,
    out: Path,
    progress: Progress,
    device: str | None = None,
) -> dict[str, Any]:
    """Time everything that runs here, or what runs on ``device``, cpu or cuda; writes the result
    and its picture into ``out``.

    Raises:
        InputError: ``out`` cannot be written.
        AquaFlowError: nothing draws on the device asked for.
    """
    require(device)
    _make_folder(out)
    contenders, notes = contenders_here(device)
    counts = (1,) if device == "cuda" else thread_counts()
    peak = NO_PEAK if device == "cuda" else _limits(measure_peak(counts), contenders)
    described = {
        **machine.describe(device),
        "peak_gflop_per_s": {str(count): rate / 1e9 for count, rate in peak.flop_per_s.items()},
        "peak_method": peak.method,
        "blend_limit": {isa: asdict(limit) for isa, limit in peak.blending.items()},
    }
    kernels = [c for c in contenders if c.name in KERNELS]
    working = _that_run(kernels, height_field(SMALL), notes)
    errors = gradient_errors([c.renderer for c in working], height_field(SMALL))
    drawn_on = kernels[0].renderer.device if device == "cuda" else CPU
    rows = time_sizes(contenders, (SMALL, *sizes), repeats, peak, notes, progress)
    result = {
        "machine": described,
        "rows": rows,
        "parts": _timed_parts(parts_of(counts, device=drawn_on), repeats, progress),
        "gradient_rel_error": errors,
        "notes": notes,
    }
    write_json(out / JSON_FILE, result)
    draw(rows, out / PICTURE_FILE, caption(described))
    return result


def _limits(peak: PeakRate, contenders: Sequence[Timed]) -> PeakRate:
    """The peak, with what the blending loops of each instruction set do at most."""
    isas = sorted({contender.isa for contender in contenders if contender.name == "cpu"})
    return replace(peak, blending={isa: measure_blend_limit(isa) for isa in isas})


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write to {out}: {error.strerror}; give another --out") from error


def time_sizes(
    contenders: Sequence[Timed],
    sizes: Sequence[Size],
    repeats: int,
    peak: PeakRate,
    notes: list[str],
    progress: Progress,
) -> list[Row]:
    """A row for every contender that takes a size; ``notes`` gets a sentence for each failure."""
    rows = []
    progress("sizes", 0, len(sizes))
    contenders = _that_run(contenders, height_field(SMALL), notes)
    for done, size in enumerate(sizes, 1):
        scene = height_field(size)
        interactions = count_interactions(scene)
        willing = [contender for contender in contenders if contender.takes(size)]
        quick = _that_run([c for c in willing if not c.slow], scene, notes)
        slow = [contender for contender in willing if contender.slow]
        load = machine.load()
        for group, times in ((quick, repeats), (slow, 1)):
            for contender, samples in _samples(group, scene, times, notes):
                rows.append(row_of(contender, size, samples, interactions, peak, load))
        progress("sizes", done, len(sizes))
    return rows


def _that_run(contenders: Sequence[Timed], scene: SplatScene, notes: list[str]) -> list[Timed]:
    """Those that get through the scene once: a run that is not counted."""
    return [c for c in contenders if _attempt(c, scene, notes) is not None]


def _samples(
    contenders: Sequence[Timed], scene: SplatScene, repeats: int, notes: list[str]
) -> list[tuple[Timed, list[Sample]]]:
    """Interleaved; a contender that fails once has none."""
    jobs = [partial(_attempt, contender, scene, notes) for contender in contenders]
    found = []
    for contender, attempts in zip(contenders, interleave(jobs, repeats), strict=True):
        samples = [sample for sample in attempts if sample is not None]
        if len(samples) == len(attempts):
            found.append((contender, samples))
    return found


def _attempt(contender: Timed, scene: SplatScene, notes: list[str]) -> Sample | None:
    try:
        return contender.sample(scene)
    except FAILURES as error:
        said = str(error).strip().partition("\n")[0] or type(error).__name__
        size = scene.size
        note = f"{contender.name} ({contender.isa}) failed at {size.n}, {size.picture}: {said}"
        if note not in notes:
            notes.append(note)
        return None


def _timed_parts(
    parts: Sequence[TimedPart], repeats: int, progress: Progress
) -> list[dict[str, Any]]:
    total, done = len(parts) * repeats, 0

    def tick() -> None:
        nonlocal done
        done += 1
        progress("parts", done, total)

    return time_parts(parts, repeats, tick)


def caption(described: dict[str, Any]) -> str:
    """What the picture says about where it comes from."""
    return (
        f"AquaFlow {described['aquaflow']} on {machine.in_words(described)}, "
        f"{described['date']}, load {described['load']}; medians on the wall"
    )


# --------------------------------------------------------------------------------------------------
# Speed means nothing for a wrong gradient: each kernel against the float64 reference.


def gradient_errors(renderers: Sequence[Renderer], scene: SplatScene) -> dict[str, float]:
    """Input -> largest relative L2 error of its gradient among ``renderers``; none: empty."""
    found = [differences(renderer, scene) for renderer in renderers]
    return {name: max(each[name] for each in found) for name in NAMES} if found else {}
