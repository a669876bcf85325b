"""A renderer that draws as the reference does passes, and one that does not is named."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from aquaflow.render.contract import CPU, Rendering
from aquaflow.render.cpu import cpu_renderer
from aquaflow.render.example_scene import NAMES, SMALL, Size, height_field
from aquaflow.render.reference import (
    MOST_GRADIENT,
    MOST_PICTURE,
    PICTURE,
    ReferenceRenderer,
    differences,
    too_far,
)

TINY = height_field(Size(60, 40, 30))


class Faulty:
    """The reference, whose pictures are brighter than they should be."""

    name, isa, threads, device = "faulty", "torch", 1, CPU

    def __init__(self, gain: float) -> None:
        self.gain = gain

    def __call__(self, *inputs: Any) -> Rendering:
        drawn = ReferenceRenderer()(*inputs)
        return replace(drawn, image=self.gain * drawn.image)


def test_the_machines_own_renderer_agrees_with_the_reference() -> None:
    found = differences(cpu_renderer(1), height_field(SMALL))
    assert list(found) == [PICTURE, *NAMES]
    assert 0.0 < max(found.values()) < 1e-4
    assert too_far(found) is None


def test_another_picture_is_said_before_its_gradients() -> None:
    found = differences(Faulty(1.1), TINY)
    assert found[PICTURE] > MOST_PICTURE
    assert found["colours"] == pytest.approx(0.1, rel=1e-3)
    said = too_far(found)
    assert said is not None
    assert said.startswith("its picture is ")
    assert "more than 3.9e-03" in said


@pytest.mark.parametrize("value", [2.0 * MOST_GRADIENT, float("nan"), float("inf")])
def test_a_gradient_that_differs_or_is_no_number_is_named(value: float) -> None:
    agreeing = dict.fromkeys((PICTURE, *NAMES), 0.0)
    assert too_far(agreeing) is None
    said = too_far({**agreeing, "scales": value})
    assert said is not None
    assert "its gradient of scales" in said
