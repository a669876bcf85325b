"""UTC of the dive's clock: which source counts, one line through it, and clocks that are set."""

from __future__ import annotations

from datetime import datetime, timezone
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aquaflow.telemetry.utc import fit_utc, utc_of
from aquaflow.types import UtcTime

SECOND = 10**9
BEGAN = datetime(2026, 11, 22, 9, 30, tzinfo=timezone.utc)
BEGAN_NS = round(BEGAN.timestamp()) * SECOND
"""UTC when the dive's clock shows 0."""


def stated(
    source: str,
    seconds: range,
    away_s: float = 0.0,
    drift: float = 0.0,
    late_s: float = 0.0,
    rng: np.random.Generator | None = None,
) -> list[UtcTime]:
    """What a clock says that is ``away_s`` off, and arrives up to ``late_s`` late."""
    samples = []
    for at in seconds:
        late_ns = 0 if rng is None else round(rng.uniform(0.0, late_s) * 1e9)
        utc_ns = BEGAN_NS + at * SECOND + round((away_s + drift * at) * 1e9)
        samples.append(UtcTime(at * SECOND + late_ns, at * SECOND + late_ns, source, utc_ns))
    return samples


def test_without_any_source_there_is_no_utc() -> None:
    assert fit_utc([]) is None
    assert utc_of(None, 5) is None
    assert fit_utc(stated("gnss/ZDA", range(2))) is None  # too few to know a glitch from the time


def test_a_receivers_time_becomes_that_of_every_moment() -> None:
    clock = fit_utc(stated("gnss/ZDA", range(30)))
    assert clock is not None
    assert clock.utc_of(0) == BEGAN
    assert utc_of(clock, -3600 * SECOND) == datetime(2026, 11, 22, 8, 30, tzinfo=timezone.utc)
    assert clock.source == "gnss/ZDA"
    assert clock.notes == ()


def test_a_wall_clock_that_is_set_in_mid_dive_counts_as_it_was_set_last() -> None:
    """A computer without a battery begins in 1970 plus its uptime, until the network comes up."""
    before = stated("computer/clock", range(400), away_s=-86_400.0)
    clock = fit_utc([*before, *stated("computer/clock", range(400, 600))])
    assert clock is not None
    assert clock.utc_of(100 * SECOND) == datetime(2026, 11, 22, 9, 31, 40, tzinfo=timezone.utc)
    assert clock.notes == ("computer/clock was set by +86400.0 s during the dive",)


def test_there_is_never_a_jump_inside_the_dive() -> None:
    samples = [
        *stated("computer/clock", range(300), away_s=-50.0),
        *stated("computer/clock", range(300, 600)),
        *stated("rov/SYSTEM_TIME", range(100, 500), away_s=0.2),
    ]
    clock = fit_utc(samples)
    assert clock is not None
    times = [clock.utc_ns(at * SECOND) for at in range(600)]
    assert {round((b - a) / SECOND, 3) for a, b in pairwise(times)} == {1.0}


def test_a_receiver_counts_before_the_autopilot_and_that_before_the_computer() -> None:
    receiver = stated("gnss/RMC", range(10))
    autopilot = stated("rov/SYSTEM_TIME", range(100), away_s=2.0)
    computer = stated("computer/clock", range(1000), away_s=-3.0)
    clock = fit_utc([*computer, *autopilot, *receiver])
    assert clock is not None
    assert clock.source == "gnss/RMC"
    assert clock.utc_of(0) == BEGAN
    assert clock.notes == (
        "computer/clock is -3.0 s away from the UTC of gnss/RMC, which is used",
        "rov/SYSTEM_TIME is +2.0 s away from the UTC of gnss/RMC, which is used",
    )
    second = fit_utc([*computer, *autopilot])
    assert second is not None
    assert second.source == "rov/SYSTEM_TIME"
    assert second.sigma_s > clock.sigma_s


def test_of_sources_of_one_kind_the_one_with_most_samples_counts() -> None:
    clock = fit_utc([*stated("a/ZDA", range(10), away_s=9.0), *stated("b/RMC", range(50))])
    assert clock is not None
    assert clock.source == "b/RMC"


def test_damaged_and_late_messages_move_nothing() -> None:
    samples = stated("gnss/ZDA", range(200))
    for k in range(5, 200, 40):
        samples[k] = UtcTime(k * SECOND, k * SECOND, "gnss/ZDA", 4 * BEGAN_NS // 3)
    samples += [UtcTime((k + 7) * SECOND, 0, "gnss/ZDA", BEGAN_NS + k * SECOND) for k in (60, 120)]
    clock = fit_utc(samples)
    assert clock is not None
    assert abs(clock.utc_ns(0) - BEGAN_NS) < SECOND // 1000
    assert clock.notes == ()


@settings(max_examples=25)
@given(
    seed=st.integers(0, 1000),
    drift=st.floats(-8e-5, 8e-5),
    length_s=st.sampled_from([20, 300, 7200]),
    late_s=st.floats(0.0, 0.4),
)
def test_the_error_stays_within_the_stated_sigma(
    seed: int, drift: float, length_s: int, late_s: float
) -> None:
    rng = np.random.default_rng(seed)
    clock = fit_utc(stated("gnss/RMC", range(length_s), drift=drift, late_s=late_s, rng=rng))
    assert clock is not None
    for at in (0, length_s, 3 * length_s):
        true_ns = BEGAN_NS + at * SECOND + round(drift * at * 1e9)
        error_s = (clock.utc_ns(at * SECOND) - true_ns) * 1e-9
        assert abs(error_s) < 3.0 * clock.sigma_at_s(at * SECOND)
    if length_s == 7200:
        assert clock.drift == pytest.approx(drift, abs=1e-5)
