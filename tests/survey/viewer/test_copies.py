"""What a browser gets of a live map: coverage is that of the plan, and of nothing else."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.state import MapCopy
from aquaflow.survey.viewer.dive_map import CLASSES, COVERAGE
from aquaflow.survey.viewer.live_viewer import pack_for_browser
from aquaflow.water.mounting import Lamp
from aquaflow.water.tone import ShownTone


def copied(count: int) -> MapCopy:
    rng = np.random.default_rng(0)
    parameters = {
        "means": rng.normal(size=(count, 3)), "quats": rng.normal(size=(count, 4)),
        "log_scales": np.full((count, 3), -3.0), "opacity_logits": np.zeros((count, 1)),
    }  # fmt: skip
    plain = {name: values.astype(np.float32) for name, values in parameters.items()}
    clear = np.full((count, 3), 0.5, np.float32)
    steps = np.ones(count, np.int32)
    return MapCopy(plain, steps, clear, None, None, ShownTone(), [Sim3.identity()])


def test_gaussians_are_coloured_by_the_plan_of_their_sub_map() -> None:
    plan: Any = SimpleNamespace(classes_of=lambda places: np.where(places[:, 0] > 0.0, 3, 1))
    splats, _, palettes = pack_for_browser(copied(50), 50, plan=plan)
    assert palettes[COVERAGE] == CLASSES
    assert np.array_equal(splats.levels[COVERAGE], np.where(splats.centres[:, 0] > 0.0, 3, 1))


def test_a_live_map_is_shown_by_its_lamp() -> None:
    rows = np.full((6, 3), 0.3, np.float32)
    lit = replace(copied(50), water=rows, lamp=Lamp(share=0.7, power=2.05, range=1.5))
    _, water, _ = pack_for_browser(lit, 50)
    assert water is not None
    assert water.lamp == (0.7, 2.05, 1.5)


def test_without_a_plan_no_coverage_is_shown() -> None:
    splats, _, palettes = pack_for_browser(copied(50), 50)
    assert COVERAGE not in palettes
    assert COVERAGE not in splats.levels
