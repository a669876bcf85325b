"""Rate, age and lag of what a device delivers."""

from __future__ import annotations

from aquaflow.drivers.live import WINDOW_S, DeviceState

SECOND = 1_000_000_000


def test_rate_age_and_lag_follow_what_came() -> None:
    now = [100 * SECOND]
    flow = DeviceState(lambda: now[0])
    assert flow.to_json() == {"rate_hz": None, "age_s": None, "lag_ms": None}
    for tenth in range(250):
        arrival = 100 * SECOND + tenth * SECOND // 10
        flow.record(arrival - 20_000_000, arrival)
    now[0] = 125 * SECOND
    assert flow.to_json() == {"rate_hz": 10.0, "age_s": 0.1, "lag_ms": 20.0}


def test_a_device_that_began_just_now_has_its_rate_already() -> None:
    flow = DeviceState(lambda: 103 * SECOND)
    for quarter in range(12):
        flow.record(0, 100 * SECOND + quarter * SECOND // 4)
    assert flow.to_json()["rate_hz"] == 4.0


def test_a_device_that_fell_silent_has_rate_zero_and_no_lag() -> None:
    now = [100 * SECOND]
    flow = DeviceState(lambda: now[0])
    flow.record(99 * SECOND, 100 * SECOND)
    now[0] = (101 + WINDOW_S) * SECOND
    assert flow.to_json() == {"rate_hz": 0.0, "age_s": 1.0 + WINDOW_S, "lag_ms": None}


def test_memory_is_bounded() -> None:
    flow = DeviceState(lambda: 0)
    for second in range(10_000):
        flow.record(0, second * SECOND)
    assert len(flow._seconds) == WINDOW_S + 1
