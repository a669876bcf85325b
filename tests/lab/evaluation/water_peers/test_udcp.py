"""The dark channel of green and blue on known haze."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.lab.evaluation.water_peers import udcp
from aquaflow.lab.evaluation.water_peers.contract import NotRestoredError
from tests.lab.evaluation.water_peers.scene import hazy_scene, matched_psnr


def test_haze_of_known_density_is_thinned() -> None:
    scene = hazy_scene((0.8, 0.8, 0.8), (0.6, 0.7, 0.8))
    restored = udcp.restore(scene.seen, None)
    gain = matched_psnr(restored, scene.clean) - matched_psnr(scene.seen, scene.clean)
    assert gain > 4.0


def test_a_picture_without_haze_stays_nearly_as_it_is() -> None:
    scene = hazy_scene((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert matched_psnr(udcp.restore(scene.seen, None), scene.clean) > 25.0


def test_red_light_does_not_count() -> None:
    """Red is gone first in water: a dark red channel is no sign that there is no haze."""
    scene = hazy_scene((0.8, 0.8, 0.8), (0.6, 0.7, 0.8))
    without_red = scene.seen.copy()
    without_red[..., 0] = 0.0
    both = [udcp._dark_channel(seen[0]) for seen in (scene.seen, without_red)]
    np.testing.assert_array_equal(*both)


def test_a_black_picture_is_refused() -> None:
    with pytest.raises(NotRestoredError, match="too dark"):
        udcp.restore(np.zeros((1, 40, 40, 3), np.float32), None)
