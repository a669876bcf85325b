"""``aquaflow prior compare``: every method on the same pairs, in turn, with what each costs."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import AquaFlowError
from aquaflow.config import PriorConfig
from aquaflow.config.stage import validated
from aquaflow.lab.bench import machine
from aquaflow.lab.prior_bench.clip_pairs import clip_pairs
from aquaflow.lab.prior_bench.known_pairs import generated_pairs, warped_pairs
from aquaflow.lab.prior_bench.methods import DenseMethod, Method, SparseMethod
from aquaflow.lab.prior_bench.pair import KnownPair, Picture
from aquaflow.lab.prior_bench.pair_figures import PairFigures, figures_of
from aquaflow.prior.factory import NetworkKind, keypoint_network, make_prior
from aquaflow.prior.keypoint_networks.keypoint_prior import KeypointPrior

Progress = Callable[[str, int, int], None]

NETWORKS: dict[NetworkKind, str] = {"xfeat": "XFeat", "aliked": "ALIKED + LightGlue"}
"""Networks of others, and their names in the table."""


@dataclass
class _Record:
    """All that one method did on the pairs of one group."""

    judged_by: str
    figures: list[PairFigures] = field(default_factory=list)
    picture_ms: list[float] = field(default_factory=list)
    pair_ms: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Methods:
    """What can run here, and why the rest cannot."""

    usable: list[Method]
    missing: list[str]


def methods_here(device: str) -> Methods:
    """The classical and the compact prior, and either keypoint network, alone and with flow.

    Raises:
        ConfigError: there is no device of that name.
        AquaFlowError: the device is not there.
    """
    usable: list[Method] = [DenseMethod("classical", make_prior(PriorConfig(kind="classical")))]
    missing = []
    settings = {"kind": "compact", "device": device}
    compact = make_prior(validated(PriorConfig, settings, "command line"))
    if compact.name == "compact":
        usable.append(DenseMethod("compact", compact))
    else:
        missing.append("compact: it has no weights or no onnxruntime here")
    for kind, title in NETWORKS.items():
        try:
            network = keypoint_network(kind, device)
        except AquaFlowError as error:
            missing.append(f"{title}: {error}")
            continue
        usable.append(SparseMethod(title, network))
        usable.append(DenseMethod(f"{title}, then flow", KeypointPrior(network)))
    return Methods(usable, missing)


def pairs_of(
    pictures: Sequence[Picture],  # [H, W, 3] RGB each
    clips: Sequence[Path],
    count: int,
    pool: Path | None,
) -> list[KnownPair]:
    """``count`` pairs of each kind; generated ones are kept in ``pool`` if it is given.

    Raises:
        InputError: a clip's folder lacks something.
    """
    real = [pair for clip in clips for pair in clip_pairs(clip, count)]
    with tempfile.TemporaryDirectory(prefix="aquaflow_pairs_") as scratch:
        generated = generated_pairs(pool or Path(scratch), count)
    return [*generated, *(warped_pairs(pictures, count) if pictures else []), *real]


def compare(
    methods: Methods,
    pairs: Sequence[KnownPair],
    progress: Progress,
) -> dict[str, Any]:
    """Means, medians and processor times by group of pairs and method."""
    records: dict[tuple[str, str], _Record] = {}
    for done, pair in enumerate(pairs):
        progress("pairs", done, len(pairs))
        for method in methods.usable:
            record = records.setdefault((pair.group, method.name), _Record(pair.judged_by))
            _run(method, pair, record)
    progress("pairs", len(pairs), len(pairs))
    return {
        "machine": machine.describe(),
        "missing": methods.missing,
        "rows": [_row(group, name, record) for (group, name), record in records.items()],
    }


def _run(method: Method, pair: KnownPair, record: _Record) -> None:
    described = []
    for picture, camera in ((pair.a, pair.camera_a), (pair.b, pair.camera_b)):
        began = time.process_time()
        described.append(method.describe(picture, camera))
        record.picture_ms.append(1e3 * (time.process_time() - began))
    began = time.process_time()
    found = method.match(*described)
    record.pair_ms.append(1e3 * (time.process_time() - began))
    record.figures.append(figures_of(pair, found))


def _row(group: str, name: str, record: _Record) -> dict[str, Any]:
    """Means of shares, medians of all else; null where there is no such thing."""
    found = record.figures
    recalls = [f.recall for f in found if f.recall is not None]
    return {
        "pairs": group,
        "count": len(found),
        "method": name,
        "judged_by": record.judged_by,
        "matches": int(np.median([f.matches for f in found])),
        "recall": round(float(np.mean(recalls)), 4) if recalls else None,
        "precision": round(float(np.mean([f.precision for f in found])), 4),
        "median_px": _median([f.median_px for f in found]),
        "rotation_deg": _median([f.rotation_deg for f in found]),
        "direction_deg": _median([f.direction_deg for f in found]),
        "picture_cpu_ms": round(float(np.median(record.picture_ms)), 1),
        "pair_cpu_ms": round(float(np.median(record.pair_ms)), 1),
    }


def _median(values: Sequence[float | None]) -> float | None:
    """None where nothing is known, or where more than half is infinite."""
    known = [value for value in values if value is not None and not math.isnan(value)]
    middle = float(np.median(known)) if known else math.inf
    return round(middle, 3) if math.isfinite(middle) else None
