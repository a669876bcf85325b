"""Suite ``ci``: synthetic dives of several kinds, small enough for every change to be judged."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from aquaflow.lab.bench.altered import dim_light, pause
from aquaflow.lab.bench.scene import BenchmarkScene
from aquaflow.lab.synthetic import SyntheticConfig, write_dive
from aquaflow.lab.synthetic.dive import FORMAT_VERSION

SMALL = {
    "frames": 24, "width": 160, "height": 120, "supersampling": 1, "camera_pitch_deg": 55.0,
}  # fmt: skip
"""A floor seen steeply is a small floor: most of the time to make a dive goes there."""

PLAIN: dict[str, dict[str, object]] = {
    "reef, loop": {"scene": "reef"},
    "flat sand, fast": {"scene": "flat_sand", "speed_m_s": 0.9},
    "wall, murky, slow": {"scene": "wall", "water": "coastal_5C", "speed_m_s": 0.5},
    "pool, tiles, display": {
        "scene": "pool",
        "camera_pitch_deg": 10.0,
        "display": "clock_and_crosshair",
    },
    "hull, equal plates": {"scene": "hull"},
    "net, open water": {"scene": "net"},
}
PIPE: dict[str, object] = {"scene": "pipe", "water": "oceanic_IB"}
"""The plain scenes by name, and the pipe that a pause is made in: what differs from SMALL."""
PAUSED, DIMMED = "pipe, clear, pause", "reef, light change"
DIMMED_FROM = "reef, loop"
"""Scenes that are made of others: the pipe with a pause, a reef whose light changes."""
PAUSE_AT, PAUSE_FRAMES = 12, 5
DIM_AT, DIM_GAIN = 12, 0.65
"""Picture at which it happens, half-way through; how many the pause adds, and what light is
left."""

REFINE_SHARE = 0.1
"""Of a preset's refining steps; the pictures have a ninth of the default's pixels."""
BRIEF: dict[str, object] = {"mapping": {"medium": {"fit_views": 8}}}
"""The water's fit takes half of a small run's time, and its observations come from every view."""

STAMP = "bench_scene.json"
"""Says what a cached scene was made from."""

Progress = Callable[[str, int, int | None], None]


def ci_scenes(cache: Path, progress: Progress) -> list[BenchmarkScene]:
    """The suite's scenes, written to ``cache`` where they are not there yet."""
    total, scenes = len(PLAIN) + 2, []
    for done, (name, kind) in enumerate(PLAIN.items()):
        progress("scenes", done, total)
        scenes.append(_cache(cache, name, {**SMALL, **kind}, _write))
    piped = {**SMALL, **PIPE}
    pipe = Path(_cache(cache, "pipe", piped, _write).recording)
    reef = next(Path(scene.recording) for scene in scenes if scene.name == DIMMED_FROM)

    def paused(out: Path, _: dict[str, object]) -> None:
        pause(pipe, out, PAUSE_AT, PAUSE_FRAMES)

    def dimmed(out: Path, _: dict[str, object]) -> None:
        dim_light(reef, out, DIM_AT, DIM_GAIN)

    stopped = {**piped, "pause": [PAUSE_AT, PAUSE_FRAMES]}
    darker = {**SMALL, **PLAIN[DIMMED_FROM], "dim": [DIM_AT, DIM_GAIN]}
    scenes.append(_cache(cache, PAUSED, stopped, paused))
    scenes.append(_cache(cache, DIMMED, darker, dimmed))
    progress("scenes", total, total)
    return scenes


def _write(out: Path, settings: dict[str, object]) -> None:
    write_dive(out, SyntheticConfig.model_validate(settings))


def _cache(
    cache: Path,
    name: str,
    settings: dict[str, object],
    make: Callable[[Path, dict[str, object]], None],
) -> BenchmarkScene:
    folder = cache / name.replace(", ", "_").replace(" ", "_")
    stamp = json.dumps({"format": FORMAT_VERSION, **settings}, sort_keys=True)
    marker = folder / STAMP
    if not marker.is_file() or marker.read_text() != stamp:
        marker.unlink(missing_ok=True)
        make(folder, settings)
        marker.write_text(stamp)
    path = str(folder)
    return BenchmarkScene(
        name, path, truth=path, clean=path, overrides=BRIEF, refine_share=REFINE_SHARE
    )
