"""The noise of a source, found from residuals that were drawn with noise of a known size."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.linalg import cholesky

from aquaflow.telemetry.start import Noise, PossibleNoise, Process, SlowPart

Array = npt.NDArray[np.float64]

T_S = np.arange(200) * 0.5
SIGMA = np.full(len(T_S), 0.01)
DRIFT, LONG_DRIFT, WAVE = Process(5.0), Process(60.0), Process(20.0, 4.0)
PART = SlowPart(0.001, 60.0, (DRIFT, LONG_DRIFT, WAVE, Process(20.0, 8.5)))
POSSIBLE = PossibleNoise(T_S, SIGMA, PART)
DRAWS = 20


def drawn(noise: Noise, seed: int, components: int = 1) -> Array:
    """[N, D] residuals with exactly this noise."""
    root = cholesky(noise.covariance(T_S, SIGMA, PART), lower=True)
    return np.asarray(root @ np.random.default_rng(seed).normal(size=(len(T_S), components)))


def found(noise: Noise) -> list[Noise]:
    return [POSSIBLE.likeliest(drawn(noise, seed)) for seed in range(DRAWS)]


@pytest.mark.parametrize("white", [1.0, 3.0, 10.0])
def test_white_noise_of_known_size_is_recovered(white: float) -> None:
    many = found(Noise(white))
    assert np.median([each.white for each in many]) == pytest.approx(white, rel=0.2)
    # What it adds on top is small against the white noise.
    assert np.median([each.size for each in many]) < 0.3 * white * SIGMA[0]


@pytest.mark.parametrize("process", [DRIFT, WAVE])
@pytest.mark.parametrize("size", [0.02, 0.2])
def test_a_lasting_error_is_recovered_with_its_size_and_its_kind(
    process: Process, size: float
) -> None:
    many = found(Noise(1.0, size, process))
    assert np.median([each.size for each in many]) == pytest.approx(size, rel=0.3)
    if size == 0.02:  # a larger one hides the white noise
        assert np.median([each.white for each in many]) == pytest.approx(1.0, abs=0.3)
    assert sum(each.process == process for each in many) >= 0.8 * DRAWS


def test_all_components_count() -> None:
    r = drawn(Noise(1.0, 0.1, DRIFT), 0, components=3)
    assert POSSIBLE.likeliest(r).size == pytest.approx(0.1, rel=0.3)


def test_noise_is_never_better_than_the_data_sheet() -> None:
    nothing = POSSIBLE.likeliest(np.zeros((len(T_S), 1)))
    assert (nothing.white, nothing.size) == (1.0, 0.0)
    np.testing.assert_allclose(
        nothing.covariance(T_S, SIGMA, PART), PART.base(T_S, SIGMA), atol=1e-15
    )
    for noise in found(Noise(1.0, 0.05, LONG_DRIFT)):
        more = noise.covariance(T_S, SIGMA, PART) - PART.base(T_S, SIGMA)
        assert np.linalg.eigvalsh(more).min() > -1e-12


def test_a_wave_averages_out_and_a_drift_does_not() -> None:
    mean = np.full(len(T_S), 1.0 / len(T_S))
    of_mean = [
        mean @ Noise(1.0, 0.1, process).covariance(T_S, SIGMA, PART) @ mean
        for process in (WAVE, LONG_DRIFT)
    ]
    assert of_mean[0] < 0.1 * of_mean[1]


def test_no_samples_leave_the_data_sheet() -> None:
    nothing = PossibleNoise(np.zeros(0), np.zeros(0), PART).likeliest(np.zeros((0, 1)))
    assert nothing == Noise(1.0, 0.0, PART.processes[0])
