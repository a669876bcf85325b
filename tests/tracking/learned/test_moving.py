"""What moves by itself has a triangulated depth that the learned one contradicts."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.config.tracking import LearnedConfig
from aquaflow.tracking.learned.fusion import add_learned
from tests.tracking.learned.learned_scenes import KNOWN_SIGMA, measured, network
from tests.tracking.tracking_scenes import CAMERA

FISH = np.s_[60:100, 100:150]


def test_a_fish_that_swims_along_is_kept_out_of_the_map() -> None:
    """It swims with the camera, so that its parallax says that it is twice as far."""
    pointmap = measured(share=1.0)
    pointmap.rho[FISH] *= 0.5
    pointmap.variance[FISH] *= 0.25
    moves = add_learned(pointmap, *network(), KNOWN_SIGMA, LearnedConfig())
    assert moves is not None
    assert moves[FISH].mean() > 0.95
    assert moves.mean() < 1.5 * 2000 / moves.size + 0.02


@pytest.mark.parametrize("sigma", [0.02, 0.05, 0.15])
def test_nothing_moves_in_a_still_scene_however_much_the_network_errs(sigma: float) -> None:
    pointmap = measured(share=1.0)
    moves = add_learned(pointmap, *network(sigma=sigma), KNOWN_SIGMA, LearnedConfig())
    assert moves is not None
    assert moves.mean() < 0.002


def test_single_pixels_are_no_fish() -> None:
    pointmap = measured(share=1.0)
    pointmap.rho[::5, ::5] *= 0.5
    moves = add_learned(pointmap, *network(), KNOWN_SIGMA, LearnedConfig())
    assert moves is not None
    assert not moves.any()


def test_what_was_never_triangulated_moves_nowhere() -> None:
    pointmap = measured(share=0.5)
    moves = add_learned(pointmap, *network(), KNOWN_SIGMA, LearnedConfig())
    assert moves is not None
    assert not moves[:, CAMERA.width // 2 + 8 :].any()


def test_nothing_is_looked_for_where_that_is_not_wanted() -> None:
    pointmap = measured(share=1.0)
    pointmap.rho[FISH] *= 0.5
    moves = add_learned(pointmap, *network(), KNOWN_SIGMA, LearnedConfig(moving=False))
    assert moves is None
