"""The sinusoidal encoding of orientations."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from aquaflow.render.water import BANDS, sinusoidal_encoding

numbers = st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9)


def test_a_rotation_becomes_81_numbers() -> None:
    assert BANDS == 4
    assert sinusoidal_encoding(torch.eye(3).reshape(9)).shape == (9 * (1 + 2 * 4),)


def test_leading_dimensions_are_kept() -> None:
    assert sinusoidal_encoding(torch.zeros(2, 5, 3), bands=2).shape == (2, 5, 3 * (1 + 2 * 2))


def test_values_are_the_number_then_sine_and_cosine_of_each_octave() -> None:
    x, y = 0.3, -0.7
    code = sinusoidal_encoding(torch.tensor([x, y], dtype=torch.float64)).tolist()
    wanted = [x, y]
    for octave in (1.0, 2.0, 4.0, 8.0):
        wanted += [math.sin(octave * math.pi * value) for value in (x, y)]
        wanted += [math.cos(octave * math.pi * value) for value in (x, y)]
    assert code == pytest.approx(wanted, abs=1e-12)


@given(numbers)
def test_numbers_and_sines_are_odd_and_cosines_even(values: list[float]) -> None:
    x = torch.tensor(values, dtype=torch.float64)
    plus, minus = (sinusoidal_encoding(sign * x).reshape(-1, 9) for sign in (1.0, -1.0))
    odd, even = [0, 1, 3, 5, 7], [2, 4, 6, 8]
    torch.testing.assert_close(minus[odd], -plus[odd])
    torch.testing.assert_close(minus[even], plus[even])
