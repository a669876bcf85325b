"""Picture metrics: known values, symmetries and limits."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aquaflow.render import image_metrics as images


def picture(seed: int = 0, shape: tuple[int, int, int] = (24, 32, 3)) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=shape)


def test_psnr_of_a_known_difference():
    assert images.psnr(picture() * 0 + 0.5, picture() * 0 + 0.6) == pytest.approx(20.0)


def test_psnr_of_equal_pictures_is_finite():
    assert images.psnr(picture(), picture()) == images.PSNR_LIMIT_DB


def test_masked_pixels_do_not_count():
    a, b = picture(1), picture(1)
    b[:12] = 0.0
    mask = np.arange(24)[:, None].repeat(32, 1) >= 12

    assert images.psnr(a, b, mask) == images.PSNR_LIMIT_DB
    assert images.psnr(a, b, np.zeros_like(mask)) == 0.0


@given(st.integers(0, 1000), st.integers(0, 1000))
def test_metrics_are_symmetric(first, second):
    a, b = picture(first), picture(second)

    assert images.psnr(a, b) == pytest.approx(images.psnr(b, a))
    assert images.ssim(a, b) == pytest.approx(images.ssim(b, a))
    assert -1.0 <= images.ssim(a, b) <= 1.0 + 1e-12


def test_ssim_of_equal_pictures_is_one():
    assert images.ssim(picture(), picture()) == pytest.approx(1.0)


def test_ssim_equals_a_direct_sum_over_zero_padded_windows():
    a, b = picture(3, (9, 8, 3)), picture(4, (9, 8, 3))
    offsets = np.arange(11) - 5
    line = np.exp(-(offsets**2) / (2 * 1.5**2))
    window = np.outer(line, line)[:, :, None] / line.sum() ** 2
    pa, pb = (np.pad(x, ((5, 5), (5, 5), (0, 0))) for x in (a, b))
    total = 0.0
    for i in range(9):
        for j in range(8):
            wa, wb = pa[i : i + 11, j : j + 11], pb[i : i + 11, j : j + 11]

            def mean(x, window=window):
                return (window * x).sum(axis=(0, 1))

            ma, mb = mean(wa), mean(wb)
            va, vb, cov = mean(wa * wa) - ma**2, mean(wb * wb) - mb**2, mean(wa * wb) - ma * mb
            total += (
                (2 * ma * mb + 1e-4)
                * (2 * cov + 9e-4)
                / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
            ).sum()

    assert images.ssim(a, b) == pytest.approx(total / (9 * 8 * 3))


@given(st.tuples(*[st.floats(0.2, 1.0)] * 3))
def test_the_gain_of_each_channel_is_found(gain):
    reference = picture(5) * 0.9

    np.testing.assert_allclose(
        images.channel_gain(reference * gain, reference), 1.0 / np.array(gain)
    )


def test_gain_of_a_black_picture_is_zero():
    assert not images.channel_gain(np.zeros((4, 4, 3)), picture(0, (4, 4, 3))).any()


def test_gain_is_fitted_under_the_mask():
    a, b = picture(6), picture(6) * 0.5
    b[0] = 1.0
    mask = np.ones((24, 32), bool)
    mask[0] = False

    np.testing.assert_allclose(images.channel_gain(a, b, mask), 0.5, rtol=1e-6)


def test_flip_of_equal_pictures_is_zero_and_grows_with_the_difference():
    pytest.importorskip("flip_evaluator", reason="it has no wheel for this processor")
    assert images.flip(picture(), picture()) == 0.0
    near, far = (images.flip(np.clip(picture() + by, 0, 1), picture()) for by in (0.02, 0.3))
    assert 0.0 < near < far < 1.0


def test_flip_of_black_and_white_is_one():
    """Andersson et al. 2020: the largest difference that there is."""
    pytest.importorskip("flip_evaluator", reason="it has no wheel for this processor")
    black = np.zeros((24, 32, 3))
    assert images.flip(black, black + 1.0) == pytest.approx(1.0, abs=0.05)


def test_flip_without_its_package_is_unknown(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    assert images.flip(picture(), picture()) is None
