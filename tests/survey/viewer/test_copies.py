"""What a browser gets of a live map: coverage is that of the plan, and of nothing else."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.state import MapCopy
from aquaflow.survey.viewer.dive_map import CLASSES, COVERAGE
from aquaflow.survey.viewer.live_viewer import pack_for_browser
from aquaflow.water.tone import ShownTone


def copied(count: int) -> MapCopy:
    rng = np.random.default_rng(0)
    parameters = {
        "means": rng.normal(size=(count, 3)), "quats": rng.normal(size=(count, 4)),
        "log_scales": np.full((count, 3), -3.0), "opacity_logits": np.zeros((count, 1)),
    }  # fmt: skip
    plain = {name: values.astype(np.float32) for name, values in parameters.items()}
    clear = np.full((count, 3), 0.5, np.float32)
    return MapCopy(plain, np.ones(count, np.int32), clear, None, ShownTone(), [Sim3.identity()])


def test_gaussians_are_coloured_by_the_plan_of_their_sub_map() -> None:
    plan: Any = SimpleNamespace(classes_of=lambda places: np.where(places[:, 0] > 0.0, 3, 1))
    splats, _, palettes = pack_for_browser(copied(50), 50, plan=plan)
    assert palettes[COVERAGE] == CLASSES
    assert np.array_equal(splats.levels[COVERAGE], np.where(splats.centres[:, 0] > 0.0, 3, 1))


def test_without_a_plan_no_coverage_is_shown() -> None:
    splats, _, palettes = pack_for_browser(copied(50), 50)
    assert COVERAGE not in palettes
    assert COVERAGE not in splats.levels
