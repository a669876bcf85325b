"""``aquaflow lab bench``: scenes times contenders, and everything that is written about them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from aquaflow.base.errors import ArgumentError
from aquaflow.base.storage.atomic import write_json
from aquaflow.config.presets import preset
from aquaflow.lab.bench import machine
from aquaflow.lab.bench.ci_suite import ci_scenes
from aquaflow.lab.bench.picture import draw
from aquaflow.lab.bench.runner import Contender, Perform, Progress, in_process, jobs_for, run_all
from aquaflow.lab.bench.scene import BenchmarkScene, real_scenes, scene_at

JSON_FILE, PICTURE_FILE = "bench.json", "bench.png"
"""What a benchmark writes."""
PEERS = ("two-view", "colmap")
"""By name; see ``peers``."""
PEERS_AT = "balanced"
"""Peers get the frames that this preset prepares."""

SUITES = ("ci", "real")
"""Synthetic dives, and a folder of recordings."""


def scenes_of(
    suite: str | None, data: Path | None, paths: Sequence[Path], out: Path, progress: Progress
) -> list[BenchmarkScene]:
    """The scenes of a suite, and those the user names.

    Raises:
        ArgumentError: there is nothing to run, or no such suite.
        InputError: something named is not there.
    """
    if suite not in (None, *SUITES):
        raise ArgumentError(f"there is no suite '{suite}'; choose {' or '.join(SUITES)}")
    if suite == "real" and data is None:
        raise ArgumentError(
            "--suite real needs a data folder: aquaflow lab bench --suite real DATA_DIR"
        )
    found = [scene_at(path) for path in paths]
    if suite == "ci":
        found += ci_scenes(out / "scenes", progress)
    elif suite == "real" and data is not None:
        found += real_scenes(data)
    if not found:
        raise ArgumentError(
            "nothing to run: give --suite ci, --suite real DATA_DIR, or --scene PATH"
        )
    return found


def contenders_of(presets: Sequence[str], peers: bool) -> list[Contender]:
    """The presets in their order, then the peers.

    Raises:
        ArgumentError: there is no such preset.
    """
    for name in presets:
        preset(name)
    return [
        *(Contender(name) for name in presets),
        *(Contender(PEERS_AT, peer) for peer in (PEERS if peers else ())),
    ]


def benchmark(
    scenes: Sequence[BenchmarkScene],
    contenders: Sequence[Contender],
    repeats: int,
    out: Path,
    progress: Progress,
    perform: Perform = in_process,
    device: str | None = None,
) -> dict[str, Any]:
    """Run everything; writes bench.json and bench.png into ``out`` and returns the former.

    Maps and learned priors run on ``device``, cpu or cuda, if it is given; peers have no say in it.
    """
    out.mkdir(parents=True, exist_ok=True)
    described = machine.describe(device)
    rows = run_all(jobs_for(scenes, contenders, repeats, out, device), progress, perform)
    result = {"machine": described, "runs": rows}
    write_json(out / JSON_FILE, result)
    draw(rows, out / PICTURE_FILE, caption(described))
    return result


def caption(described: dict[str, Any]) -> str:
    """What the picture says about where it comes from."""
    return (
        f"AquaFlow {described['aquaflow']} on {machine.in_words(described)}, "
        f"{described['date']}; every run is one marker; "
        "peers find poses only, AquaFlow's time holds the map too"
    )
