"""The fastest of the renderers that a machine has: each is tried, none is believed.

What is faster depends on the GPU, its driver, the way to its memory and the processor's cores; no
table knows that.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from statistics import median

from aquaflow.base.errors import first_line
from aquaflow.render.contract import Renderer
from aquaflow.render.example_scene import SMALL, Size, SplatScene, height_field
from aquaflow.render.reference import differences, too_far

log = logging.getLogger(__name__)

TYPICAL = Size(50_000, 480, 270)
"""A map in the middle of a dive, at the size that pictures have by default."""
LIMIT_S = 1.0
"""For each renderer, after the first picture, which compiles what there is to compile."""
MOST_STEPS = 20


def fastest(makers: Sequence[Callable[[], Renderer]]) -> Renderer:
    """The renderer that draws and differentiates a typical map in the least time.

    One that draws something else than the reference, or fails, is left out, and that is logged; so
    is the choice. The last of ``makers`` is taken where all others are left out.
    """
    scene = height_field(TYPICAL)
    measured: list[tuple[float, Renderer]] = []
    for make in makers:
        try:
            renderer = make()
            wrong = too_far(differences(renderer, height_field(SMALL)))
            seconds = step_seconds(renderer, scene)
        except Exception as error:  # of drivers, which say what they like
            log.warning("a renderer is left out: %s", first_line(error))
            continue
        if wrong is not None:
            log.warning("renderer %s is left out: %s", renderer.name, wrong)
        else:
            measured.append((seconds, renderer))
    if not measured:
        return makers[-1]()
    seconds, chosen = min(measured, key=lambda each: each[0])
    said = ", ".join(f"{each.name} {1e3 * s:.1f} ms" for s, each in measured)
    log.info("renderer %s is taken: a picture and its gradient take %s", chosen.name, said)
    return chosen


def step_seconds(renderer: Renderer, scene: SplatScene) -> float:
    """Median time of a picture and its gradient."""
    times: list[float] = []
    began = time.perf_counter()
    while len(times) < 2 or (time.perf_counter() - began < LIMIT_S and len(times) < MOST_STEPS):
        leaves, start = scene.leaves(renderer.device), time.perf_counter()
        _, gradients = scene.differentiated_by(renderer, leaves)
        gradients[-1].cpu()  # waits for the device
        times.append(time.perf_counter() - start)
        if len(times) == 1:
            began = time.perf_counter()
    return median(times[1:])
