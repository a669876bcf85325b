"""Telemetry of a dive: in the order of measurement, each moment once, copied for another thread."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.telemetry.telemetry import CHUNK, Telemetry
from aquaflow.types import Depth, UtcTime, Velocity


def heard(count: int) -> Telemetry:
    telemetry = Telemetry()
    for i in range(count):
        telemetry.add(Velocity(i * 10**9, 0, "dvl", (0.1 * i, 0.0, 1.0), 0.01))
    return telemetry


@pytest.mark.parametrize("count", [1, CHUNK - 1, CHUNK, CHUNK + 1, 3 * CHUNK])
def test_a_copy_stays_as_it_was_when_telemetry_goes_on(count: int) -> None:
    telemetry = heard(count)
    copy = telemetry.copy()
    telemetry.add(Velocity(count * 10**9, 0, "dvl", (9.0, 9.0, 9.0), 0.01))
    telemetry.add(Depth(0, 0, "bar30", 1.0))
    telemetry.add(UtcTime(0, 0, "clock", 1))
    [then], [now] = copy.of(Velocity), telemetry.of(Velocity)
    assert (len(then), len(now)) == (count, count + 1)
    np.testing.assert_array_equal(now.values[:-1], then.values)
    np.testing.assert_array_equal(then.values[:, 0], 0.1 * np.arange(count))
    assert copy.of(Depth) == []
    assert copy.utc == []


def test_samples_that_come_late_or_twice_are_put_in_order() -> None:
    telemetry = Telemetry()
    for t_s, depth_m in ((2, 2.0), (1, 1.0), (3, 3.0), (2, 9.0)):
        telemetry.add(Depth(t_s * 10**9, 0, "bar30", depth_m))
    [series] = telemetry.of(Depth)
    assert series.t_s.tolist() == [1.0, 2.0, 3.0]
    assert series.values[:, 0].tolist() == [1.0, 2.0, 3.0]
