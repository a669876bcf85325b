"""Suite ``ci``: synthetic dives of several kinds, small enough for every change to be judged."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from aquaflow.evaluation.bench.altered import dim_light, pause
from aquaflow.evaluation.bench.scene import Scene
from aquaflow.synthetic import SyntheticConfig, write_dive
from aquaflow.synthetic.dive import FORMAT_VERSION

SMALL = {
    "frames": 24, "width": 160, "height": 120, "supersampling": 1, "camera_pitch_deg": 55.0,
}  # fmt: skip
"""A floor seen steeply is a small floor: most of the time to make a dive goes there."""

DIVES: dict[str, dict[str, object]] = {
    "reef, loop": {"scene": "reef"},
    "flat sand, fast": {"scene": "flat_sand", "speed_m_s": 0.9},
    "wall, murky": {"scene": "wall", "water": "coastal_5C"},
    "pipe, clear, slow": {"scene": "pipe", "water": "oceanic_IB", "speed_m_s": 0.45},
}
PAUSED, DIMMED = "reef, pause", "reef, light change"
ALTERED_FROM = "reef, loop"
PAUSE_AT, PAUSE_FRAMES = 12, 5
DIM_AT, DIM_GAIN = 12, 0.65

REFINE_SHARE = 0.1
"""Of a preset's refining steps; the pictures have a ninth of the default's pixels."""

STAMP = "bench_scene.json"
"""Says what a cached scene was made from."""

Progress = Callable[[str, int, int | None], None]


def ci_scenes(cache: Path, progress: Progress) -> list[Scene]:
    """The suite's scenes, written to ``cache`` where they are not there yet."""
    total, scenes = len(DIVES) + 2, []
    for done, (name, kind) in enumerate(DIVES.items(), 1):
        scenes.append(_cached(cache, name, {**SMALL, **kind}, _write))
        progress("scenes", done, total)
    reef = Path(scenes[list(DIVES).index(ALTERED_FROM)].recording)
    made_from = {**SMALL, **DIVES[ALTERED_FROM]}

    def paused(out: Path, _: dict[str, object]) -> None:
        pause(reef, out, PAUSE_AT, PAUSE_FRAMES)

    def dimmed(out: Path, _: dict[str, object]) -> None:
        dim_light(reef, out, DIM_AT, DIM_GAIN)

    scenes.append(_cached(cache, PAUSED, {**made_from, "pause": [PAUSE_AT, PAUSE_FRAMES]}, paused))
    scenes.append(_cached(cache, DIMMED, {**made_from, "dim": [DIM_AT, DIM_GAIN]}, dimmed))
    progress("scenes", total, total)
    return scenes


def _write(out: Path, settings: dict[str, object]) -> None:
    write_dive(out, SyntheticConfig.model_validate(settings))


def _cached(
    cache: Path,
    name: str,
    settings: dict[str, object],
    make: Callable[[Path, dict[str, object]], None],
) -> Scene:
    folder = cache / name.replace(", ", "_").replace(" ", "_")
    stamp = json.dumps({"format": FORMAT_VERSION, **settings}, sort_keys=True)
    marker = folder / STAMP
    if not marker.is_file() or marker.read_text() != stamp:
        marker.unlink(missing_ok=True)
        make(folder, settings)
        marker.write_text(stamp)
    path = str(folder)
    return Scene(name, path, truth=path, clean=path, refine_share=REFINE_SHARE)
