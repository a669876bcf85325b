"""Random series have the sigma, the correlation and the shares that are asked for."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.lab.synthetic.telemetry.series import choose, random_walk, stretches, wander


def test_wandering_errors_have_their_sigma_and_correlation_time() -> None:
    t = np.linspace(0.0, 40_000.0, 400_001)
    series = wander(t, 0.5, 20.0, 2, np.random.default_rng(0))
    # 40,000 s are 1000 independent stretches of 2 correlation times: sigma to about 3 %.
    np.testing.assert_allclose(series.std(axis=0), 0.5, rtol=0.1)
    for lag_s, expected in ((5.0, np.exp(-0.25)), (20.0, np.exp(-1.0)), (200.0, 0.0)):
        lag = round(lag_s / 0.1)
        correlation = (series[lag:] * series[:-lag]).mean(axis=0) / series.var(axis=0)
        np.testing.assert_allclose(correlation, expected, atol=0.1)


def test_wandering_errors_begin_with_their_full_sigma() -> None:
    starts = [wander(np.arange(3.0), 2.0, 50.0, 1, np.random.default_rng(k))[0] for k in range(500)]
    assert np.std(starts) == pytest.approx(2.0, rel=0.1)


def test_a_walk_gains_with_the_root_of_time() -> None:
    t = np.linspace(0.0, 100.0, 1001)
    walks = random_walk(t, 0.3, 2000, np.random.default_rng(1))
    np.testing.assert_array_equal(walks[0], 0.0)
    for k in (100, 1000):
        assert walks[k].std() == pytest.approx(0.3 * np.sqrt(t[k]), rel=0.06)


def test_single_samples_are_chosen_independently() -> None:
    missing = choose(100_000, 0.02, np.random.default_rng(2))
    assert missing.mean() == pytest.approx(0.02, rel=0.1)
    assert (missing[1:] & missing[:-1]).mean() == pytest.approx(0.02**2, rel=0.5)


def test_stretches_come_as_often_and_last_as_long_as_stated() -> None:
    t = np.linspace(0.0, 200_000.0, 1_000_001)
    lost = stretches(t, 0.5, 3.0, np.random.default_rng(3))
    begins = (lost[1:] & ~lost[:-1]).sum()
    # A stretch begins 0.5 times per minute of what lies between stretches.
    assert begins / ((~lost).sum() * 0.2 / 60.0) == pytest.approx(0.5, rel=0.08)
    assert lost.sum() * 0.2 / begins == pytest.approx(3.0, rel=0.08)


def test_no_stretches_where_there_are_none_a_minute() -> None:
    assert not stretches(np.arange(100.0), 0.0, 3.0, np.random.default_rng(0)).any()
