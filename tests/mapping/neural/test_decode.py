"""The compiled decoder of one view against its definition, and which Gaussians it takes."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from numpy import uint8, zeros
from torch import Tensor

from aquaflow.mapping.neural.decoder import (
    DECODED,
    Decoder,
    Trunk,
    decode,
    decoded_torch,
    in_picture,
    observation,
    visible_tokens,
    without_residuals,
)
from aquaflow.render.library import library_or_none
from tests.mapping.mapping_scenes import CAMERA, path, view_of
from tests.mapping.neural.decoder_scene import ROWS, Scene

CENTRE = torch.tensor([0.1, -0.2, -1.0])

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(library_or_none() is None, reason="needs the compiled kernels"),
]


class Case:
    """A decoder that has learned something, and everything it takes, in one precision."""

    def __init__(self, dtype: torch.dtype, **settings: Any) -> None:
        scene = Scene(**settings)
        self.decoder: Decoder = scene.decoder.to(dtype)
        tokens = visible_tokens(scene.groups, torch.ones(ROWS, dtype=torch.bool))
        trunk = scene.decoder.double().trunk(tokens, scene.local, scene.shared)
        self.decoder = scene.decoder.to(dtype)
        self.hidden = trunk.hidden.detach().to(dtype).requires_grad_()
        self.trunk = Trunk(tokens, self.hidden, None)
        self.places = tokens.places(torch.arange(ROWS) != 5)
        self.parameters = {
            name: tensor.detach().to(dtype).requires_grad_(name in DECODED)
            for name, tensor in scene.parameters.items()
        }
        self.pull = {name: scene.normal(*scene.parameters[name].shape) for name in DECODED}

    def compiled(self, threads: int = 1) -> dict[str, Tensor]:
        return decode(self.decoder, self.trunk, self.parameters, self.places, CENTRE, threads)

    def defined(self) -> dict[str, Tensor]:
        centre = CENTRE.to(self.hidden.dtype)
        return decoded_torch(self.decoder, self.trunk, self.parameters, self.places, centre)

    def gradients(self, seen: dict[str, Tensor]) -> list[Tensor]:
        """Of all that can be learned from one view."""
        parts = [(seen[name] * self.pull[name].to(seen[name].dtype)).sum() for name in DECODED]
        d = self.decoder
        weights = [d.view.weight, *d.geometry.parameters(), *d.colour.parameters()]
        inputs = [self.hidden, *(self.parameters[name] for name in DECODED), *weights]
        return list(torch.autograd.grad(torch.stack(parts).sum(), inputs))


SIZES: list[dict[str, Any]] = [
    {"width": 8},
    {"width": 32, "local_width": 16},
    {"width": 64, "distance": False},
]


@pytest.mark.parametrize("settings", SIZES)
def test_the_compiled_view_is_what_the_definition_says(settings: dict[str, Any]) -> None:
    seen = Case(torch.float32, **settings).compiled()
    wanted = Case(torch.float64, **settings).defined()
    for name, tensor in wanted.items():
        torch.testing.assert_close(seen[name].double(), tensor, rtol=0, atol=3e-6)


@pytest.mark.parametrize("settings", SIZES)
def test_its_gradients_are_those_of_the_definition(settings: dict[str, Any]) -> None:
    case, exact = Case(torch.float32, **settings), Case(torch.float64, **settings)
    found = case.gradients(case.compiled())
    for gradient, wanted in zip(found, exact.gradients(exact.defined()), strict=True):
        assert float((gradient.double() - wanted).norm() / wanted.norm()) < 2e-5


def test_two_threads_decode_the_same_and_learn_the_same_of_each_gaussian() -> None:
    one, two = Case(torch.float32, width=8), Case(torch.float32, width=8)
    seen, other = one.compiled(1), two.compiled(2)
    for name in DECODED:
        assert torch.equal(seen[name], other[name])
    for a, b in zip(one.gradients(seen)[:4], two.gradients(other)[:4], strict=True):
        assert torch.equal(a, b)


def test_untouched_heads_change_nothing_bit_for_bit() -> None:
    case = Case(torch.float32, width=8, trained=False)
    seen = case.compiled()
    for name, tensor in case.parameters.items():
        assert torch.equal(seen[name], tensor)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_place_or_a_gradient_that_is_no_number_costs_its_gaussian_only(bad: float) -> None:
    case = Case(torch.float32, width=8)
    clean = case.compiled()
    case.parameters["means"][3, 1] = bad
    seen = case.compiled()
    others = torch.arange(ROWS) != 3
    assert torch.equal(seen["log_scales"][3], case.parameters["log_scales"][3])
    assert torch.equal(seen["log_scales"][others], clean["log_scales"][others])
    case.pull["log_scales"][4, 0] = bad
    gradients = case.gradients(seen)
    assert all(bool(torch.isfinite(gradients[i]).all()) for i in (0, 4, 5, 6, 7, 8))


def test_an_unsound_group_is_left_as_it_is() -> None:
    case = Case(torch.float32, width=8)
    sound = torch.ones(len(case.hidden), dtype=torch.bool)
    sound[case.places[0]] = False
    case.trunk = dataclasses.replace(case.trunk, sound=sound)
    row = case.trunk.tokens.rows[case.places[0]]
    assert torch.equal(case.compiled()["quats"][row], case.parameters["quats"][row])
    assert torch.equal(case.defined()["quats"][row], case.parameters["quats"][row])


def test_initial_attributes_are_found_back_from_what_is_seen() -> None:
    case = Case(torch.float64, width=8)
    rows = case.trunk.tokens.rows[case.places]
    seen = case.defined()
    o = observation(case.parameters["means"][rows], CENTRE.double())
    residuals = case.decoder.residuals(case.trunk, case.places, o)
    found = without_residuals({name: seen[name][rows] for name in DECODED}, residuals)
    for name in DECODED:
        torch.testing.assert_close(found[name], case.parameters[name][rows])


def test_what_is_far_outside_the_picture_or_behind_the_camera_is_not_decoded() -> None:
    blank = view_of(zeros((CAMERA.height, CAMERA.width, 3), uint8), path(1)[0])
    means = torch.tensor([[0.0, 0.0, 2.0], [1.5, 0.0, 2.0], [9.0, 0.0, 2.0], [0.0, 0.0, -2.0]])
    seen = in_picture(means, blank, blank.viewmat())
    assert seen.tolist() == [True, True, False, False]
    assert not bool(in_picture(torch.full((1, 3), math.nan), blank, blank.viewmat()))
