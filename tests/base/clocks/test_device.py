"""Device clocks against simulated ones whose truth is known."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.base.clocks.device import BUCKET_NS, WINDOW_BUCKETS, ClockMapping
from aquaflow.base.clocks.wall import WallClockWatch

MS = 1_000_000
SECOND = 1_000_000_000
BOOTED_NS = 7_000 * SECOND
"""CLOCK_MONOTONIC when the simulated device's clock is at 0."""

JITTERS = ("exponential", "uniform", "half-normal")


@dataclass(frozen=True)
class Messages:
    """True moments, the device's stamps of them, and arrivals; ns, [N] each."""

    true_ns: npt.NDArray[np.int64]
    device_ns: npt.NDArray[np.int64]
    arrival_ns: npt.NDArray[np.int64]
    sent_back_ns: npt.NDArray[np.int64]
    """How long before its arrival each one had been asked for."""


def simulated(
    seconds: float,
    rate_hz: float = 50.0,
    jitter: str = "exponential",
    drift_ppm: float = 50.0,
    constant_ns: int = 0,
    seed: int = 0,
) -> Messages:
    """5 ms of jitter, a spike of 20 ms every twentieth message, both never negative.

    The latency that all messages share is ``constant_ns``: 0 unless a test is about it, since
    nobody can see it from one side.
    """
    rng = np.random.default_rng(seed)
    count = int(seconds * rate_hz)
    true = np.arange(count) / rate_hz
    kinds = {
        "exponential": rng.exponential(5e-3, count),
        "uniform": rng.uniform(0.0, 10e-3, count),
        "half-normal": np.abs(rng.normal(0.0, 5e-3, count)),
    }
    late = kinds[jitter] + 20e-3 * (rng.random(count) < 0.05) + constant_ns * 1e-9
    asked = constant_ns * 1e-9 + rng.exponential(5e-3, count)
    # A link keeps the order of its messages.
    arrival = np.maximum.accumulate(true + late)
    true_ns = BOOTED_NS + np.round(true * 1e9).astype(np.int64)
    return Messages(
        true_ns,
        np.round(true * (1.0 - 1e-6 * drift_ppm) * 1e9).astype(np.int64),
        BOOTED_NS + np.round(arrival * 1e9).astype(np.int64),
        np.round((arrival - true + asked) * 1e9).astype(np.int64),
    )


def errors_ms(
    mapping: ClockMapping, messages: Messages, every_round_trip: int = 0
) -> npt.NDArray[np.float64]:
    """Error of each message's mapped time, as a live consumer gets it, ms [N]."""
    errors = []
    for k, true_ns in enumerate(messages.true_ns.tolist()):
        answered = every_round_trip > 0 and k % every_round_trip == 0
        mapping.add(
            int(messages.device_ns[k]),
            int(messages.arrival_ns[k]),
            int(messages.sent_back_ns[k]) if answered else None,
        )
        mapped = mapping.to_monotonic(int(messages.device_ns[k]))
        assert mapped is not None
        errors.append((mapped - true_ns) / MS)
    return np.array(errors)


def rms(values: npt.NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("jitter", JITTERS)
@pytest.mark.parametrize("rate_hz", [4.0, 10.0, 50.0])
def test_drift_jitter_and_spikes_leave_less_than_a_millisecond_after_thirty_seconds(
    rate_hz: float, jitter: str
) -> None:
    mapping = ClockMapping()
    errors = errors_ms(mapping, simulated(90.0, rate_hz, jitter))
    assert rms(errors[int(30 * rate_hz) :]) < 1.0
    assert rms(errors[int(30 * rate_hz) : int(60 * rate_hz)]) < 1.0
    report = mapping.report()
    assert report is not None
    assert report.drift_ppm == pytest.approx(50.0, abs=10.0)
    assert report.resets == report.outliers == 0


def test_before_the_first_message_nothing_is_known() -> None:
    mapping = ClockMapping()
    assert mapping.to_monotonic(5) is None
    assert mapping.report() is None


def test_times_long_after_the_last_message_follow_the_drift() -> None:
    mapping = ClockMapping()
    errors_ms(mapping, simulated(120.0))
    later = 150 * SECOND
    mapped = mapping.to_monotonic(round(later * (1.0 - 50e-6)))
    assert mapped is not None
    assert abs(mapped - (BOOTED_NS + later)) < MS


def test_a_latency_that_all_messages_share_is_seen_with_round_trips_only() -> None:
    messages = simulated(60.0, constant_ns=10 * MS)
    blind, asking = ClockMapping(), ClockMapping()
    assert rms(errors_ms(blind, messages)[1500:]) == pytest.approx(10.0, abs=1.0)
    assert rms(errors_ms(asking, messages, every_round_trip=50)[1500:]) < 1.0
    told = asking.report()
    assert told is not None
    assert told.round_trips
    assert 9 * MS < told.uncertainty_ns < 12 * MS
    assert not blind.report().round_trips  # type: ignore[union-attr]


def test_a_one_sided_round_trip_is_wrong_by_no_more_than_it_says() -> None:
    """A peer that answers at once to requests that waited 20 ms (notes/measurements.md#clocks)."""
    mapping = ClockMapping()
    for k in range(100):
        device_ns = k * SECOND // 10
        mapping.add(device_ns, BOOTED_NS + device_ns, round_trip_ns=20 * MS)
    report = mapping.report()
    assert report is not None
    assert abs(report.offset_ns - BOOTED_NS) <= report.uncertainty_ns == 10 * MS


@pytest.mark.parametrize("restart_ns", [0, 3 * SECOND])
def test_a_reboot_starts_anew_and_is_counted(
    restart_ns: int, caplog: pytest.LogCaptureFixture
) -> None:
    mapping = ClockMapping("DVL")
    before, after = simulated(40.0), simulated(40.0, seed=1)
    errors_ms(mapping, before)
    gap_ns = 100 * SECOND
    for device_ns, arrival_ns in zip(after.device_ns, after.arrival_ns, strict=True):
        mapping.add(int(device_ns) + restart_ns, int(arrival_ns) + gap_ns)
    mapped = mapping.to_monotonic(restart_ns + int(after.device_ns[-1]))
    assert mapped is not None
    assert abs(mapped - (int(after.true_ns[-1]) + gap_ns)) < MS
    assert mapping.resets == 1
    assert "the clock of DVL began anew" in caplog.text


def test_a_clock_set_forward_starts_anew() -> None:
    mapping = ClockMapping()
    first, then = simulated(40.0), simulated(40.0, seed=1)
    errors_ms(mapping, first)
    jump_ns = 3_600 * SECOND
    for device_ns, arrival_ns in zip(then.device_ns, then.arrival_ns, strict=True):
        mapping.add(int(device_ns) + jump_ns, int(arrival_ns) + 40 * SECOND)
    assert mapping.resets == 1


def test_damaged_stamps_are_left_out_and_counted() -> None:
    messages = simulated(60.0)
    mapping = ClockMapping()
    for k, (device_ns, arrival_ns) in enumerate(
        zip(messages.device_ns.tolist(), messages.arrival_ns.tolist(), strict=True)
    ):
        if k % 100 == 99:
            mapping.add(device_ns + 10**15 * (-1 if k % 200 == 99 else 1), arrival_ns)
        mapping.add(device_ns, arrival_ns)
    mapped = mapping.to_monotonic(int(messages.device_ns[-1]))
    assert mapped is not None
    assert abs(mapped - int(messages.true_ns[-1])) < MS
    assert mapping.resets == 0
    assert mapping.outliers == len(messages.true_ns) // 100


def test_a_stalled_link_that_delivers_all_at_once_is_no_new_clock() -> None:
    mapping = ClockMapping()
    messages = simulated(60.0)
    stalled = (messages.true_ns > BOOTED_NS + 40 * SECOND) & (
        messages.true_ns < BOOTED_NS + 45 * SECOND
    )
    arrival_ns = np.where(stalled, BOOTED_NS + 45 * SECOND, messages.arrival_ns)
    late = Messages(messages.true_ns, messages.device_ns, arrival_ns, messages.sent_back_ns)
    errors = errors_ms(mapping, late)
    assert rms(errors[1500:]) < 1.0
    assert mapping.resets == 0


def test_messages_that_swapped_places_do_not_matter() -> None:
    messages = simulated(60.0)
    mapping = ClockMapping()
    order = np.arange(len(messages.true_ns)).reshape(-1, 10)[:, ::-1].ravel()
    for k in order.tolist():
        mapping.add(int(messages.device_ns[k]), int(messages.arrival_ns[k]) + 200 * MS)
    mapped = mapping.to_monotonic(int(messages.device_ns[-1]))
    assert mapped is not None
    assert abs(mapped - int(messages.true_ns[-1]) - 200 * MS) < MS
    assert mapping.resets == mapping.outliers == 0


def test_memory_is_bounded_over_a_long_dive() -> None:
    mapping = ClockMapping()
    for k in range(3 * WINDOW_BUCKETS):
        mapping.add(k * BUCKET_NS, BOOTED_NS + k * BUCKET_NS)
    assert len(mapping._buckets) == WINDOW_BUCKETS


def test_a_wall_clock_jump_of_three_hours_is_logged_and_changes_nothing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.WARNING)
    messages = simulated(60.0)
    watch, watched, alone = WallClockWatch(), ClockMapping(), ClockMapping()
    errors_ms(alone, messages)
    jump_ns = 3 * 3600 * SECOND
    for k, arrival_ns in enumerate(messages.arrival_ns.tolist()):
        wall_ns = 1_700_000_000 * SECOND + arrival_ns + (jump_ns if k >= 2000 else 0)
        reading = watch.read(arrival_ns, wall_ns)
        assert reading.jump_ns == (jump_ns if k == 2000 else 0)
        watched.add(int(messages.device_ns[k]), arrival_ns)
    assert watched.report() == alone.report()
    assert watch.jumps == 1
    assert "the wall clock was set by +10800.000 s" in caplog.text


def test_a_slewed_wall_clock_is_no_jump() -> None:
    watch = WallClockWatch()
    for k in range(100):
        watch.read(k * SECOND, 10**18 + k * SECOND + k * MS // 2)
    assert watch.jumps == 0


def test_the_watch_reads_the_systems_clocks() -> None:
    watch = WallClockWatch()
    reading = watch.read()
    assert reading.offset_ns > 0
    assert watch.read().jump_ns == 0


def test_a_restarted_process_goes_on_with_what_the_one_before_knew() -> None:
    first, second = ClockMapping(), ClockMapping()
    messages = simulated(90.0)
    half = len(messages.device_ns) // 2
    for device_ns, arrival_ns in zip(
        messages.device_ns[:half], messages.arrival_ns[:half], strict=True
    ):
        first.add(int(device_ns), int(arrival_ns))
    # The device speaks before anybody tells the new process what was known.
    second.add(int(messages.device_ns[half]), int(messages.arrival_ns[half]))
    second.resume(json.loads(json.dumps(first.learned_mapping())))
    second.add(int(messages.device_ns[half + 1]), int(messages.arrival_ns[half + 1]))
    report = second.report()
    assert report is not None
    assert report.drift_ppm == pytest.approx(50.0, abs=15.0)
    mapped = second.to_monotonic(int(messages.device_ns[half + 1]))
    assert mapped is not None
    assert abs(mapped - int(messages.true_ns[half + 1])) < MS


def test_a_device_that_was_restarted_meanwhile_is_learned_anew() -> None:
    first, second = ClockMapping(), ClockMapping()
    errors_ms(first, simulated(40.0))
    second.resume(first.learned_mapping())
    again = simulated(40.0, seed=1)
    for device_ns, arrival_ns in zip(again.device_ns, again.arrival_ns, strict=True):
        second.add(int(device_ns), int(arrival_ns) + 100 * SECOND)
    assert second.resets == 1
    mapped = second.to_monotonic(int(again.device_ns[-1]))
    assert mapped is not None
    assert abs(mapped - (int(again.true_ns[-1]) + 100 * SECOND)) < MS


@pytest.mark.parametrize("damage", [[["x", 1, 2, 3, 4]], [[1, 2]], [[None] * 5], [3]])
def test_a_damaged_memory_of_a_clock_is_not_used(
    damage: Any, caplog: pytest.LogCaptureFixture
) -> None:
    mapping = ClockMapping("DVL")
    mapping.resume(damage)
    errors_ms(mapping, simulated(2.0))
    assert mapping.report() is not None
    assert "the clock of DVL is learned anew" in caplog.text
