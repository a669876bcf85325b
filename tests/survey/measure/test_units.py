"""Lengths and areas as people read them."""

from __future__ import annotations

import pytest

from aquaflow.survey.measure.quantity import Quantity, as_read


def test_metres_become_feet_with_their_sigma_and_interval() -> None:
    assert as_read(Quantity(3.048, 0.3048, 2.4384, 3.6576, "m"), "feet") == Quantity(
        pytest.approx(10.0),  # type: ignore[arg-type]
        pytest.approx(1.0),  # type: ignore[arg-type]
        pytest.approx(8.0),  # type: ignore[arg-type]
        pytest.approx(12.0),  # type: ignore[arg-type]
        "ft",
    )
    acre = as_read(Quantity(4046.8564224, 1.0, 4000.0, 4100.0, "m\u00b2"), "feet")
    assert (acre.value, acre.unit) == (pytest.approx(43560.0), "ft\u00b2")


@pytest.mark.parametrize("unit", ["", "\u00b0", "map units", "square map units"])
def test_what_is_not_metric_stays(unit: str) -> None:
    quantity = Quantity(1.0, 0.1, 0.8, 1.2, unit)
    assert as_read(quantity, "feet") is quantity
