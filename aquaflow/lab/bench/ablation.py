"""``aquaflow lab ablate``: what parts and skips (docs/architecture.md#skips) cost and bring."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any

from rich.console import Console
from rich.table import Table

from aquaflow.base.errors import AquaFlowError, ArgumentError
from aquaflow.config.presets import merge
from aquaflow.lab.bench import machine
from aquaflow.lab.bench.job import BenchJob
from aquaflow.lab.bench.runner import Perform, Progress, Row, in_process, row_of
from aquaflow.lab.bench.scene import BenchmarkScene
from aquaflow.lab.evaluation.oracle_views import make_oracle
from aquaflow.prior.folder import CARD

PRESET = "balanced"
"""The preset whose parts are left out, one at a time."""
ORACLE_SIGMA = 0.05
"""Relative error of an oracle's ranges: what the best monocular networks reach in air."""
CI_SCENES = ("reef, loop", "wall, murky, slow")
"""Of the ci suite: relief and much water; the others would double the time."""


@dataclass(frozen=True)
class AblatedPart:
    """A part of the method that the config can switch off, and the overrides that do it."""

    name: str
    overrides: dict[str, Any] = field(default_factory=dict)
    built: bool = True
    oracle: bool = False
    """True if it tracks with an oracle of the scene (docs/prior.md#oracle)."""


def _medium(**settings: object) -> dict[str, Any]:
    return {"mapping": {"medium": settings}}


def _decoder(**settings: object) -> dict[str, Any]:
    return {"mapping": {"decoder": {"enabled": True, **settings}}}


def _insertion(**settings: object) -> dict[str, Any]:
    return {"mapping": {"insertion": settings}}


def _tracking(**settings: object) -> dict[str, Any]:
    return {"tracking": settings}


def _gate(**settings: object) -> dict[str, Any]:
    return _tracking(gate=settings)


LEARNED: tuple[tuple[str, dict[str, Any], bool], ...] = (
    ("the compact prior", {"kind": "compact"}, False),
    (
        f"an oracle of {100 * ORACLE_SIGMA:.0f} %",
        {"kind": "folder", "folder": "oracle of the scene"},
        True,
    ),
)
"""Priors that know ranges: name, settings, and whether each scene needs one of its own."""
WITHOUT: tuple[tuple[str, dict[str, Any]], ...] = (
    ("", {}),
    (", without learned depth", _tracking(learned={"depth": False})),
    (", with learned start", _tracking(learned={"start": True})),
    (", without learned matches", {"prior": {"learned_matches": False}}),
    (", without confidence of matches", {"prior": {"confidence": False}}),
    (", residual ray", _tracking(residual="ray")),
    (", residual point", _tracking(residual="point")),
)
"""What is left out of each."""

THRESHOLD = 0.1
"""Of P_a; the paper's 1.0 lets none in, 0.3 leaves 213 Gaussians of the reef of the ci suite."""
NEVER_AGREES = 1e-9
"""Relative range difference: no map is this close, so no ray counts as explained."""

PARTS = (
    AblatedPart("full"),
    AblatedPart("without medium", _medium(enabled=False)),
    AblatedPart("with attenuation by orientation", _medium(directional=True)),
    AblatedPart("without medium in insertion", _insertion(medium_reduced=False)),
    AblatedPart(
        "with insertion wherever P_a is above a threshold",
        _insertion(selection="threshold", tau_a=THRESHOLD),
    ),
    AblatedPart("with rendered ranges in insertion", _insertion(colour_range="rendered")),
    AblatedPart("without camera shading", _medium(shading=False)),
    AblatedPart("without water fit", _medium(fit=False)),
    AblatedPart("without pose refinement", {"mapping": {"optimiser": {"poses": 0.0}}}),
    AblatedPart("without depth loss", {"mapping": {"loss": {"depth": 0.0}}}),
    AblatedPart("without loop closure", _tracking(graph={"enabled": False})),
    AblatedPart("without the monitor of scale", _tracking(monitor={"enabled": False})),
    AblatedPart("without adjustment at the end", _tracking(adjustment={"at_end": False})),
    AblatedPart("without masking of overlays", _tracking(mask_overlays=False)),
    AblatedPart("without joint adjustment", _tracking(adjustment={"enabled": False})),
    AblatedPart("with neural Gaussians (LGPD)", _decoder()),
    AblatedPart("with neural Gaussians, base held as inserted", _decoder(optimise_initial=False)),
    AblatedPart(
        "with neural Gaussians, observation before the attention",
        _decoder(observation="before_attention"),
    ),
    AblatedPart("with neural Gaussians, without distance embedding", _decoder(distance=False)),
    AblatedPart("with neural Gaussians, an MLP instead of LGPD", _decoder(variant="mlp")),
    *(
        AblatedPart(f"with {name}{without}", merge({"prior": prior}, overrides), oracle=oracle)
        for name, prior, oracle in LEARNED
        for without, overrides in WITHOUT
    ),
    AblatedPart("without confidence of matches", {"prior": {"confidence": False}}),
    AblatedPart(
        "skip off: insertion only where the map is wrong", _insertion(agreement=NEVER_AGREES)
    ),
    AblatedPart("skip off: duplicate and stationary frames", _gate(skip_duplicates=False)),
    AblatedPart(
        "skip off: dark, blurred or blinded frames",
        _gate(skip_dark=False, skip_blurred=False, skip_blinded=False),
    ),
    AblatedPart("skip off: encoder features reused", _tracking(reuse_encodings=False)),
    AblatedPart("skip off: matching seeded by motion", _tracking(seed_matching=False)),
    AblatedPart("skip off: solver stops when converged", _tracking(stop_converged=False)),
    AblatedPart("skip off: crowded places searched once a second", _tracking(crowd_look_s=0.0)),
    AblatedPart(
        "skip off: keyframes adjusted again when a quarter are new",
        _tracking(adjustment={"at_loops_share": 0.0}),
    ),
    AblatedPart("skip off: retrieval only at keyframes", built=False),
    AblatedPart("without exposure of each view", _medium(exposure=False)),
    AblatedPart("without sunlight on each view", {"mapping": {"sunlight": {"enabled": False}}}),
    AblatedPart("skip off: medium off in clear water", _medium(off_when_clear=False)),
    AblatedPart("skip off: no Gaussians in open water", built=False),
    AblatedPart(
        "with neural Gaussians, skip off: only voxel groups in view",
        _decoder(visible_groups=False),
    ),
    AblatedPart(
        "skip off: views already explained",
        {"mapping": {"optimiser": {"skip_explained": False}}},
    ),
    AblatedPart(
        "skip off: light, and all tiles, at one look in four",
        {"mapping": {"optimiser": {"full_look_every": 1}}},
    ),
    AblatedPart(
        "skip off: tiles at the noise floor",
        {"mapping": {"optimiser": {"noise_floor": 0.0}}},
    ),
    AblatedPart(
        "with neural Gaussians, skip off: trunk cached over several views",
        _decoder(views_per_trunk=1),
    ),
)
"""In the order of the table; a part lights up once it has a switch in the config."""


def parts_called(names: Sequence[str]) -> list[AblatedPart]:
    """The full system, and the parts whose names contain one of ``names``; all without any.

    Raises:
        ArgumentError: a name is of no part.
    """
    for name in names:
        if not any(name in part.name for part in PARTS):
            raise ArgumentError(
                f"no part is called '{name}'; give a word of the table's first column"
            )
    chosen = [part for part in PARTS[1:] if any(name in part.name for name in names)]
    return [PARTS[0], *(chosen if names else PARTS[1:])]


def ablate(
    scenes: Sequence[BenchmarkScene],
    out: Path,
    progress: Progress,
    parts: Sequence[AblatedPart] = PARTS,
    perform: Perform = in_process,
) -> dict[str, Any]:
    """Run every part's scenes, interleaved; means over the scenes (docs/formats.md#json-output)."""
    built = [part for part in parts if part.built]
    found: dict[str, list[Row]] = {part.name: [] for part in parts}
    total, done = len(built) * len(scenes), 0
    for scene in scenes:
        for part in built:
            folder = str(out / "ablation" / f"dive_{done:03d}")
            overrides = part.overrides
            if part.oracle:
                overrides = merge(overrides, {"prior": {"folder": str(_oracle(scene, out))}})
            job = BenchJob(scene, PRESET, folder, overrides=overrides)
            found[part.name].append(row_of(job, machine.load(), perform(job)))
            done += 1
            progress("runs", done, total)
    return {"rows": [_row(part, found[part.name]) for part in parts]}


def _oracle(scene: BenchmarkScene, out: Path) -> Path:
    """The scene's oracle, written once; without true ranges the job itself says what is missing."""
    folder = out / "oracles" / scene.name.replace(", ", "_").replace(" ", "_")
    if not (folder / CARD).is_file():
        with suppress(AquaFlowError):
            make_oracle(Path(scene.recording), folder, ORACLE_SIGMA, lambda *_: None)
    return folder


def _row(part: AblatedPart, runs: list[Row]) -> dict[str, Any]:
    """A failed run leaves no number: a mean over fewer scenes would compare other things."""
    failed = [f"{run['scene']}: {run['failed']}" for run in runs if run["failed"]]
    whole = runs if not failed else []

    def mean(values: list[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return round(fmean(known), 4) if known and len(known) == len(values) else None

    return {
        "part": part.name,
        "psnr": mean([run["psnr"] for run in whole]),
        "ssim": mean([run.get("ssim") for run in whole]),
        "flip": mean([run.get("flip") for run in whole]),
        "lpips": mean([run.get("lpips") for run in whole]),
        "gaussians": mean([run.get("gaussians") for run in whole]),
        "posed_pct": mean([_posed_pct(run) for run in whole]),
        "ate_pct": mean([run["ate_pct_sim3"] for run in whole]),
        "ms_per_frame": mean([run["ms_per_frame"]["total"] for run in whole]),
        "cpu_ms_per_frame": mean([_cpu_ms(run) for run in whole]),
        "restored_psnr": mean([run["restored_psnr"] for run in whole]),
        "built": part.built,
        "failed": failed,
    }


def _posed_pct(run: Row) -> float | None:
    return 100.0 * float(run["tracked"]) / max(run["frames"], 1) if "tracked" in run else None


def _cpu_ms(run: Row) -> float | None:
    """Of all threads; unlike the time that passed, it hardly knows what else the machine does."""
    spent_s = run.get("cpu_s")
    return None if spent_s is None else 1e3 * float(spent_s) / max(run["frames"], 1)


SHOWN = (
    ("psnr", "PSNR dB", ".2f"),
    ("ssim", "SSIM", ".3f"),
    ("flip", "FLIP", ".3f"),
    ("lpips", "LPIPS", ".3f"),
    ("gaussians", "Gaussians", ".0f"),
    ("posed_pct", "posed %", ".0f"),
    ("restored_psnr", "restored dB", ".2f"),
    ("ate_pct", "ATE %", ".3f"),
    ("ms_per_frame", "ms/frame", ".0f"),
    ("cpu_ms_per_frame", "CPU ms/frame", ".0f"),
)
"""Keys of a row, their titles and formats."""


def print_ablation(rows: Sequence[Row], console: Console) -> None:
    """Each number with its difference from the full system."""
    full = rows[0]
    table = Table(show_edge=False, pad_edge=False)
    table.add_column("part")
    for _, title, _ in SHOWN:
        table.add_column(title, justify="right", no_wrap=True)
    for row in rows:
        if not row["built"]:
            table.add_row(row["part"], "not built", *[""] * (len(SHOWN) - 1), style="dim")
            continue
        table.add_row(row["part"], *(_cell(row[key], full[key], form) for key, _, form in SHOWN))
    console.print(table)
    for row in rows:
        for sentence in row["failed"]:
            console.print(f"{row['part']}: {sentence}", highlight=False, markup=False)


def _cell(value: float | None, full: float | None, form: str) -> str:
    if value is None:
        return "-"
    if full is None or value == full:
        return format(value, form)
    return f"{format(value, form)} ({format(value - full, '+' + form)})"
