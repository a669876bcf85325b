"""Motions between the cameras of a pair: along the optical axis, and as they were without it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from aquaflow.lab.training.pair_generator.cameras import (
    MOST_FORWARD,
    WIDE,
    PairMotion,
    first_camera,
    second_camera,
)
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.scene import Detail, random_scenes

pytestmark = pytest.mark.usefixtures("one_thread")


def steps_of(motion: PairMotion) -> torch.Tensor:
    """[B, 3] steps of second cameras in the frames of the first, median depth 1 m, high up."""
    scene = random_scenes(Draw(1), 32, Detail(terrain=64, texture=128))
    T_a = first_camera(Draw(2), scene.terrain)
    T_a[:, 2, 3] += 10.0
    T_b = second_camera(Draw(3), scene.terrain, T_a, torch.ones(32), motion)
    return (T_a[:, :3, :3].mT @ (T_b - T_a)[:, :3, 3:])[..., 0]


def test_forward_motion_is_along_the_axis_both_ways_and_never_too_near() -> None:
    steps = steps_of(PairMotion(baseline=0.8, forward=1.0))
    share = steps[:, 2].abs() / steps.norm(dim=-1)
    assert float(share.median()) > 0.9
    assert bool((steps[:, 2] > 0).any())
    assert bool((steps[:, 2] < 0).any())
    assert float(steps[:, 2].max()) <= MOST_FORWARD + 1e-4


def test_motions_without_forward_are_drawn_as_ever() -> None:
    mixed = steps_of(replace(WIDE, forward=1e-9))
    assert torch.allclose(steps_of(WIDE).norm(dim=-1), mixed.norm(dim=-1), atol=1e-5)
