"""Moments of exposure: believed where they can be true, bridged where the clock jumped."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.drivers.live import MAX_FUTURE_NS, MAX_LATENCY_NS, ExposureClock

MS = 1_000_000
PERIOD = 33 * MS
LATENCY = 20 * MS
DEVICE_ZERO = 7_000_000 * MS
"""What the device's clock shows when the host's shows 0."""


def run(claimed: np.ndarray, arrivals: np.ndarray, device: np.ndarray | None = None):
    clock = ExposureClock()
    stamps = [
        clock.stamp(int(c), None if device is None else int(device[i]), int(a))
        for i, (c, a) in enumerate(zip(claimed, arrivals, strict=True))
    ]
    return clock, np.array(stamps)


@pytest.fixture
def truth() -> np.ndarray:
    return 10**12 + PERIOD * np.arange(200, dtype=np.int64)


def test_a_plausible_claim_is_taken_as_it_is(truth):
    clock, stamps = run(truth, truth + LATENCY)
    assert np.array_equal(stamps, truth)
    assert clock.repaired == 0


def test_without_a_claim_it_is_the_arrival():
    clock = ExposureClock()
    assert clock.stamp(None, None, 123) == 123
    assert clock.repaired == 0


@pytest.mark.parametrize("off", [MAX_LATENCY_NS + LATENCY, -MAX_FUTURE_NS - LATENCY - MS])
def test_an_impossible_claim_becomes_the_arrival(truth, off):
    clock, stamps = run(truth - off, truth + LATENCY)
    assert np.array_equal(stamps, truth + LATENCY)
    assert clock.repaired == len(truth)


def test_stamps_slightly_in_the_future_as_vivids_are_believed(truth):
    _, stamps = run(truth + 30 * MS, truth)
    assert np.array_equal(stamps, truth + 30 * MS)


def test_stamps_always_increase():
    claimed = 10**12 + np.array([0, 40, 20, 20, 60]) * MS
    clock, stamps = run(claimed, claimed + 80 * MS)
    assert np.all(np.diff(stamps) > 0)
    assert clock.repaired == 2


@pytest.mark.parametrize("jump", [5_000 * MS, -5_000 * MS, 300 * MS, -300 * MS])
def test_a_jump_of_synchronisation_is_bridged_by_the_devices_own_clock(truth, jump):
    claimed = truth.copy()
    claimed[50:60] += jump
    clock, stamps = run(claimed, truth + LATENCY, truth + DEVICE_ZERO)
    assert np.abs(stamps - truth).max() < 5 * MS
    assert np.all(np.diff(stamps) > 0)
    assert clock.repaired == 10


def test_a_first_claim_that_is_wrong_is_not_kept(truth):
    claimed = truth.copy()
    claimed[:5] += 8_000 * MS
    _, stamps = run(claimed, truth + LATENCY, truth + DEVICE_ZERO)
    assert np.abs(stamps[:5] - truth[:5]).max() <= LATENCY
    assert np.array_equal(stamps[10:], truth[10:])


def test_the_drift_of_a_device_clock_is_followed_and_is_no_repair(truth):
    fast = truth + (truth - truth[0]) // 10_000  # 100 ppm
    clock, stamps = run(truth, truth + LATENCY, fast + DEVICE_ZERO)
    assert np.abs(stamps - truth).max() < MS
    assert clock.repaired == 0


def test_a_device_that_restarts_its_clock_is_followed(truth):
    device = truth + DEVICE_ZERO
    device[100:] -= device[100]
    _, stamps = run(truth, truth + LATENCY, device)
    assert np.abs(stamps - truth).max() <= LATENCY
