"""Grey world on casts that it can and cannot take off."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.lab.evaluation.water_peers import contract as grey_world
from aquaflow.lab.evaluation.water_peers.contract import NotRestoredError


def test_a_pure_cast_is_taken_off_exactly() -> None:
    rng = np.random.default_rng(0)
    clean = rng.uniform(0.2, 0.6, (2, 8, 9, 3)).astype(np.float32)
    clean *= clean.mean() / clean.mean(axis=(1, 2), keepdims=True)
    cast = np.array([[0.4, 0.9, 1.1], [0.7, 0.6, 0.5]], np.float32)
    restored = grey_world.restore(clean * cast[:, None, None], None)
    brightness = cast.mean(axis=1)[:, None, None, None]
    np.testing.assert_allclose(restored, clean * brightness, rtol=1e-4)


def test_a_black_channel_is_refused() -> None:
    pictures = np.full((1, 4, 4, 3), 0.5, np.float32)
    pictures[..., 0] = 0.0
    with pytest.raises(NotRestoredError, match="black"):
        grey_world.restore(pictures, None)
