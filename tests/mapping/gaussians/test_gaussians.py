"""The Gaussians' own bookkeeping: colours that stay positive, tensors that stay in step."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from aquaflow.mapping.gaussians import GaussianMap, raw_colour
from aquaflow.render.contract import radiance


def numbered(start: int, count: int) -> dict[str, torch.Tensor]:
    """Gaussians that carry their number in every entry of every tensor."""
    number = torch.arange(start, start + count, dtype=torch.float32)[:, None]
    return {name: number.repeat(1, width) for name, width in GaussianMap.WIDTHS.items()}


@given(st.lists(st.floats(1e-3, 2.0), min_size=1, max_size=30))
def test_raw_colours_and_radiance_are_each_others_inverse(values: list[float]) -> None:
    colour = torch.tensor(values)
    torch.testing.assert_close(radiance(raw_colour(colour)), colour, rtol=1e-3, atol=1e-5)


def test_black_gets_a_finite_raw_colour() -> None:
    raw = raw_colour(torch.zeros(3))
    assert torch.isfinite(raw).all()
    torch.testing.assert_close(radiance(raw), torch.full((3,), 1e-3), rtol=1e-2, atol=0.0)


@given(st.floats(-1e4, 1e4, width=32))
def test_radiance_is_never_negative_nor_infinite(raw: float) -> None:
    value = radiance(torch.tensor(raw))
    assert torch.isfinite(value)
    assert value >= 0.0


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 2**8 - 1)), max_size=6))
def test_growing_and_dropping_keep_all_tensors_and_keyframes_in_step(
    moves: list[tuple[int, int]],
) -> None:
    gaussians, expected, next_number = GaussianMap(), [], 0
    for keyframe, (count, bits) in enumerate(moves):
        gaussians.extend(numbered(next_number, count), keyframe)
        expected += [(next_number + i, keyframe) for i in range(count)]
        next_number += count
        mask = [bool(bits >> (i % 8) & 1) for i in range(len(expected))]
        gaussians.keep(torch.tensor(mask, dtype=torch.bool))
        expected = [pair for pair, kept in zip(expected, mask, strict=True) if kept]
    assert len(gaussians) == len(expected)
    assert gaussians.keyframes.tolist() == [keyframe for _, keyframe in expected]
    for name, width in GaussianMap.WIDTHS.items():
        tensor = gaussians.parameters[name]
        assert tensor.is_contiguous()
        assert tensor.tolist() == [[float(number)] * width for number, _ in expected]


def test_parameters_mean_scale_opacity_and_colour() -> None:
    gaussians = GaussianMap()
    gaussians.extend(numbered(0, 2), keyframe=3)
    torch.testing.assert_close(gaussians.scales[1], torch.full((3,), 2.718282))
    torch.testing.assert_close(gaussians.opacities, torch.tensor([0.5, 0.731059]))
    torch.testing.assert_close(gaussians.colours, radiance(gaussians.parameters["raw_colours"]))
    assert gaussians.means is gaussians.parameters["means"]
