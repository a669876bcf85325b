"""A contender on a scene as a row of ``render_bench.json``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from aquaflow.lab.bench.render.contenders import Timed
from aquaflow.lab.bench.render.interactions import BACKWARD_FLOP, FORWARD_FLOP
from aquaflow.lab.bench.render.peak import PeakRate
from aquaflow.lab.bench.render.timing import Sample, spread_of
from aquaflow.render.example_scene import Size

Row = dict[str, Any]

PASSES = (("fwd", FORWARD_FLOP), ("bwd", BACKWARD_FLOP))
"""By their name in a row, with the operations of one Gaussian at one pixel."""


def row_of(
    contender: Timed,
    size: Size,
    samples: Sequence[Sample],
    interactions: int,
    peak: PeakRate,
    load: float | None,
) -> Row:
    """Medians in ms; rates by the GPU's time, else by the CPU time where one thread worked, else
    by the wall's."""
    row: Row = {
        "renderer": contender.name,
        "isa": contender.isa,
        "threads": contender.threads,
        "n": size.n,
        "width": size.width,
        "height": size.height,
        "repeats": len(samples),
        "load": load,
        "interactions": interactions,
    }
    busy_s = {}
    for key, _ in PASSES:
        wall = spread_of([getattr(sample, f"{key}_ms") for sample in samples])
        own = {clock: _median(samples, f"{key}_{clock}_ms") for clock in ("cpu", "gpu")}
        row |= {
            f"{key}_ms": wall.median,
            f"{key}_ms_half_range": wall.half_range,
            **{f"{key}_{clock}_ms": ms for clock, ms in own.items()},
        }
        known = [ms for ms in (own["gpu"], own["cpu"]) if ms is not None]
        busy_s[key] = 1e-3 * (known[0] if known else wall.median)
        row[f"{key}_interactions_per_s"] = interactions / busy_s[key] if busy_s[key] else None
    row["gpu_mb"] = _median(samples, "gpu_mb")
    row["share_of_peak"] = _shares(contender, busy_s, interactions, peak)
    row["share_of_blend_limit"] = _blend_shares(contender, busy_s, interactions, peak)
    row["stage_ms"] = _stages(samples)
    return row


def _median(samples: Sequence[Sample], name: str) -> float | None:
    """None where it was not measured."""
    found = [value for sample in samples if (value := getattr(sample, name)) is not None]
    return spread_of(found).median if found else None


def _shares(
    contender: Timed, busy_s: dict[str, float], interactions: int, peak: PeakRate
) -> dict[str, float] | None:
    """Useful operations/s over the peak's; None where no peak was measured for the device."""
    most = None if contender.isa == "cuda" else peak.flop_per_s.get(contender.threads)
    if most is None or not all(busy_s.values()):
        return None
    flop = {key: each * interactions for key, each in PASSES}
    shares = {key: flop[key] / busy_s[key] / most for key, _ in PASSES}
    return {**shares, "both": sum(flop.values()) / sum(busy_s.values()) / most}


def _blend_shares(
    contender: Timed, busy_s: dict[str, float], interactions: int, peak: PeakRate
) -> dict[str, float] | None:
    """Of the rate at which the kernels blend where nothing is in vain and nothing else is done."""
    limit = peak.blending.get(contender.isa)
    if contender.name != "cpu" or limit is None or not all(busy_s.values()):
        return None
    least = {key: s / contender.threads for key, s in limit.seconds(interactions).items()}
    shares = {key: least[key] / busy_s[key] for key, _ in PASSES}
    return {**shares, "both": sum(least.values()) / sum(busy_s.values())}


def _stages(samples: Sequence[Sample]) -> dict[str, float] | None:
    """Medians of the stages; None where the renderer does not report them."""
    names = list(samples[0].stage_ms)
    return {n: spread_of([s.stage_ms[n] for s in samples]).median for n in names} or None
