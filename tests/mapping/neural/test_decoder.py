"""The decoder against a reference that goes Gaussian by Gaussian, and what it must never do."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from aquaflow.geometry.similarity import rotation_from_quaternion
from aquaflow.mapping.neural.decoder import (
    BUCKET,
    FURTHEST,
    GroupAttention,
    Tokens,
    apply_residuals,
    encoded_observation,
    observation,
    visible_tokens,
)
from aquaflow.mapping.neural.voxel_groups import EMPTY
from aquaflow.render.water import sinusoidal_encoding
from tests.mapping.neural.decoder_scene import CENTRE, ROWS, Scene

VARIANTS = ("lgpd", "mlp")
ENTRIES = ("after_attention", "before_attention")


pytestmark = pytest.mark.usefixtures("one_thread")


def reference(scene: Scene, row: int) -> Tensor:
    """[9] The residual of one Gaussian, as the paper says it, from the raw weights."""
    weights = dict(scene.decoder.named_parameters())
    group = int(scene.groups.group[row])
    members = [int(i) for i in scene.groups.table[group] if i != EMPTY]
    first = scene.config.observation == "before_attention"

    def gamma(i: int) -> Tensor:
        ray = scene.means[i] - CENTRE
        d = torch.linalg.vector_norm(ray)
        return sinusoidal_encoding(
            torch.cat([ray / d, d[None]] if scene.config.distance else [ray / d])
        )

    def token(i: int) -> Tensor:
        e = weights["local.weight"] @ scene.local[i] + weights["local.bias"]
        e = e + weights["shared.weight"] @ scene.shared[group]
        return e + weights["view.weight"] @ gamma(i) if first else e

    e = token(row)
    if scene.config.variant == "lgpd":
        query = weights["mixer.query.weight"] @ e
        scores = torch.stack([query @ token(i) / math.sqrt(len(e)) for i in members])
        share = torch.exp(scores) / torch.exp(scores).sum()
        values = [weights["mixer.value.weight"] @ token(i) for i in members]
        z = e + sum(w * v for w, v in zip(share, values, strict=True))
    else:
        z = e + weights["mixer.outer.weight"] @ torch.relu(weights["mixer.inner.weight"] @ e)
    hidden = weights["first.weight"] @ z + weights["first.bias"]
    if not first:
        hidden = hidden + weights["view.weight"] @ gamma(row)
    hidden = torch.relu(hidden)
    half = len(hidden) // 2
    geometry = weights["geometry.weight"] @ hidden[:half] + weights["geometry.bias"]
    colour = weights["colour.weight"] @ hidden[half:] + weights["colour.bias"]
    config = scene.config
    turn = config.max_turn * torch.tanh(geometry[:3])
    scale = config.max_log_scale * torch.tanh(geometry[3:])
    return torch.cat([turn, scale, config.max_colour * torch.tanh(colour)])


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("distance", [True, False])
@pytest.mark.parametrize("observation", ENTRIES)
def test_each_gaussian_is_decoded_as_the_reference_says(
    variant: str, distance: bool, observation: str
) -> None:
    scene = Scene(variant=variant, distance=distance, observation=observation)
    wanted = torch.stack([reference(scene, row) for row in range(ROWS)])
    torch.testing.assert_close(scene.residuals(), wanted, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("observation", ENTRIES)
def test_gradients_are_those_of_the_reference(variant: str, observation: str) -> None:
    scene = Scene(variant=variant, observation=observation)
    scene.local.requires_grad_()
    scene.shared.requires_grad_()
    leaves = [scene.local, scene.shared, *scene.decoder.parameters()]
    upstream = scene.normal(ROWS, 9)
    found = torch.autograd.grad((scene.residuals() * upstream).sum(), leaves)
    slow = torch.stack([reference(scene, row) for row in range(ROWS)])
    wanted = torch.autograd.grad((slow * upstream).sum(), leaves)
    for a, b in zip(found, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("variant", VARIANTS)
def test_gradients_pass_finite_differences_through_the_parameters(variant: str) -> None:
    scene = Scene(variant=variant)
    everyone = torch.ones(ROWS, dtype=torch.bool)
    tokens = visible_tokens(scene.groups, everyone)
    rows = tokens.rows[tokens.places(everyone)]
    o = observation(scene.means[rows], CENTRE)

    def decode(local: Tensor, shared: Tensor, quats: Tensor, raw: Tensor) -> tuple[Tensor, ...]:
        trunk = scene.decoder.trunk(tokens, local, shared)
        residuals = scene.decoder.residuals(trunk, tokens.places(everyone), o)
        base = {**scene.parameters, "quats": quats, "raw_colours": raw}
        decoded = apply_residuals(base, rows, residuals)
        return decoded["quats"], decoded["log_scales"], decoded["raw_colours"]

    inputs = (scene.local, scene.shared, scene.parameters["quats"], scene.parameters["raw_colours"])
    inputs = tuple(tensor.clone().requires_grad_() for tensor in inputs)
    assert torch.autograd.gradcheck(decode, inputs, fast_mode=True)


def test_one_trunk_serves_several_views_exactly() -> None:
    scene = Scene()
    everyone = torch.ones(ROWS, dtype=torch.bool)
    tokens = visible_tokens(scene.groups, everyone)
    scene.local.requires_grad_()
    places = tokens.places(everyone)
    rows = tokens.rows[places]
    centres = [CENTRE, CENTRE + 0.3, -CENTRE]

    def loss(shared_trunk: bool) -> Tensor:
        trunk = scene.decoder.trunk(tokens, scene.local, scene.shared)
        total = torch.zeros((), dtype=torch.float64)
        for centre in centres:
            if not shared_trunk:
                trunk = scene.decoder.trunk(tokens, scene.local, scene.shared)
            o = observation(scene.means[rows], centre)
            total = total + scene.decoder.residuals(trunk, places, o).pow(2).sum()
        return total

    (once,) = torch.autograd.grad(loss(True), scene.local)
    (each,) = torch.autograd.grad(loss(False), scene.local)
    torch.testing.assert_close(once, each, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("variant", VARIANTS)
def test_buckets_and_padding_change_nothing(variant: str) -> None:
    scene = Scene(variant=variant)
    everyone = torch.ones(ROWS, dtype=torch.bool)
    tokens = visible_tokens(scene.groups, everyone)
    assert len({width for _, width in tokens.buckets}) > 1
    width = 3 * BUCKET
    table = torch.nn.functional.pad(scene.groups.table, (0, width - 7), value=EMPTY)[tokens.groups]
    valid = (table != EMPTY).reshape(-1)
    rows = torch.where(table == EMPTY, table[:, :1], table).reshape(-1)
    one = Tokens(rows, valid, tokens.groups, ((len(table), width),))
    torch.testing.assert_close(scene.residuals(one), scene.residuals(tokens), rtol=0, atol=1e-13)


def test_the_order_within_a_group_does_not_matter() -> None:
    scene = Scene()
    tokens = visible_tokens(scene.groups, torch.ones(ROWS, dtype=torch.bool))
    count, width = tokens.buckets[-1]
    order = torch.arange(len(tokens.rows))
    last = order[-count * width :].view(count, width).flip(1).reshape(-1)
    order[-count * width :] = last
    turned = dataclasses.replace(tokens, rows=tokens.rows[order], valid=tokens.valid[order])
    torch.testing.assert_close(scene.residuals(turned), scene.residuals(), rtol=0, atol=1e-13)


@given(st.integers(0, 999), st.integers(1, 8))
def test_attention_is_permutation_equivariant(seed: int, count: int) -> None:
    random = torch.Generator().manual_seed(seed)
    attention = GroupAttention(6, random).double()
    e = torch.randn(2, count, 6, generator=random, dtype=torch.float64)
    order = torch.randperm(count, generator=random)
    valid = torch.ones(2, count, dtype=torch.bool)
    there, back = attention(e, valid)[:, order], attention(e[:, order], valid)
    torch.testing.assert_close(back, there, rtol=0, atol=1e-12)


def test_neighbours_matter_to_lgpd_and_not_to_the_mlp_and_other_groups_to_neither() -> None:
    for variant in VARIANTS:
        scene = Scene(variant=variant)
        before = scene.residuals()
        mates = scene.groups.group == scene.groups.group[0]
        scene.local[0] += 1.0
        changed = (scene.residuals() != before).any(1)
        assert bool(changed[0])
        assert bool(changed[mates].all()) == (variant == "lgpd")
        assert not bool(changed[~mates].any())


def test_only_groups_with_a_visible_gaussian_are_decoded_and_they_whole() -> None:
    scene = Scene()
    visible = torch.zeros(ROWS, dtype=torch.bool)
    visible[[0, 14]] = True
    tokens = visible_tokens(scene.groups, visible)
    wanted = torch.isin(scene.groups.group, scene.groups.group[visible])
    assert torch.equal(torch.sort(tokens.rows[tokens.valid]).values, torch.nonzero(wanted)[:, 0])
    assert torch.equal(
        torch.sort(tokens.rows[tokens.places(visible)]).values, torch.tensor([0, 14])
    )
    everyone = torch.ones(ROWS, dtype=torch.bool)
    places = tokens.places(everyone)
    rows = tokens.rows[places]
    trunk = scene.decoder.trunk(tokens, scene.local, scene.shared)
    part = scene.decoder.residuals(trunk, places, observation(scene.means[rows], CENTRE))
    torch.testing.assert_close(part, scene.residuals()[rows], rtol=0, atol=1e-13)


def test_nothing_visible_decodes_to_nothing() -> None:
    scene = Scene()
    none = torch.zeros(ROWS, dtype=torch.bool)
    tokens = visible_tokens(scene.groups, none)
    trunk = scene.decoder.trunk(tokens, scene.local, scene.shared)
    o = observation(torch.zeros(0, 3, dtype=torch.float64), CENTRE)
    residuals = scene.decoder.residuals(trunk, tokens.places(none), o)
    assert residuals.shape == (0, 9)
    decoded = apply_residuals(scene.parameters, torch.zeros(0, dtype=torch.int64), residuals)
    for name, tensor in scene.parameters.items():
        assert torch.equal(decoded[name], tensor)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_new_gaussian_is_bit_for_bit_its_initial_state_and_the_heads_can_learn(
    variant: str,
) -> None:
    scene = Scene(trained=False, variant=variant)
    residuals = scene.residuals()
    decoded = apply_residuals(scene.parameters, torch.arange(ROWS), residuals)
    for name, tensor in scene.parameters.items():
        assert torch.equal(decoded[name], tensor)
    residuals.sum().backward()
    assert scene.decoder.geometry.weight.grad is not None
    assert float(scene.decoder.geometry.weight.grad.abs().sum()) > 0.0


def test_residual_rotations_are_unit_and_turn_in_the_gaussians_own_axes() -> None:
    scene = Scene()
    residuals = scene.residuals()
    q0 = scene.parameters["quats"]
    q = apply_residuals(scene.parameters, torch.arange(ROWS), residuals)["quats"]
    torch.testing.assert_close(q.norm(dim=1), torch.ones(ROWS, dtype=torch.float64))
    for row in (0, 9, 22):
        u = residuals[row, :3].detach()
        turn = torch.cat([torch.ones(1, dtype=torch.float64), u]) / math.sqrt(1 + float(u @ u))
        wanted = rotation_from_quaternion(q0[row].numpy()) @ rotation_from_quaternion(turn.numpy())
        found = torch.from_numpy(rotation_from_quaternion(q[row].detach().numpy()))
        torch.testing.assert_close(found, torch.from_numpy(wanted))


def test_residuals_stay_within_their_stated_limits() -> None:
    scene = Scene(max_turn=0.3, max_log_scale=0.7, max_colour=0.2)
    scene.local *= 1e3
    largest = scene.residuals().abs().amax(0)
    limits = torch.tensor([0.3] * 3 + [0.7] * 3 + [0.2] * 3, dtype=torch.float64)
    assert bool((largest <= limits + 1e-6).all())  # the limits are float32
    assert bool((largest > 0.9 * limits).any())


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e6])
@pytest.mark.parametrize("where", ["local", "shared"])
def test_a_feature_that_is_no_sensible_number_costs_its_group_only(bad: float, where: str) -> None:
    scene = Scene()
    clean = scene.residuals().detach()
    row = 10
    hit = scene.groups.group == scene.groups.group[row]
    features = scene.local if where == "local" else scene.shared
    features[row if where == "local" else int(scene.groups.group[row]), 1] = bad
    features.requires_grad_()
    residuals = scene.residuals()
    assert not bool(residuals[hit].any())
    assert torch.equal(residuals[~hit], clean[~hit])
    residuals.sum().backward()
    gradients = [features.grad, *(weight.grad for weight in scene.decoder.parameters())]
    assert all(g is not None and bool(torch.isfinite(g).all()) for g in gradients)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_place_that_is_no_number_costs_that_gaussian_only(bad: float) -> None:
    scene = Scene()
    clean = scene.residuals().detach()
    scene.means[3, 1] = bad
    residuals = scene.residuals()
    assert not bool(residuals[3].any())
    others = torch.arange(ROWS) != 3
    assert torch.equal(residuals[others], clean[others])


def test_the_observation_is_the_direction_and_the_distance_in_scene_scales() -> None:
    means = torch.tensor([[3.0, 0.0, 4.0]])
    o = observation(means, torch.zeros(3), scene_scale=2.0)
    torch.testing.assert_close(o, torch.tensor([[0.6, 0.0, 0.8, 2.5]]))
    each = observation(means.expand(2, 3), torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 3.0]]))
    torch.testing.assert_close(each, torch.tensor([[0.6, 0.0, 0.8, 5.0], [0.0, 0.0, 1.0, 1.0]]))


@given(st.floats(-1e30, 1e30), st.floats(0.0, 1e30))
def test_an_encoded_observation_is_bounded_wherever_the_camera_is(x: float, z: float) -> None:
    means = torch.tensor([[x, 0.0, z]], dtype=torch.float64)
    code = encoded_observation(observation(means, torch.zeros(3, dtype=torch.float64)))
    assert bool(torch.isfinite(code).all())
    assert float(code.abs().max()) <= FURTHEST


def test_without_distance_nothing_depends_on_it() -> None:
    means = torch.tensor([[0.3, 0.1, 0.9]], dtype=torch.float64)
    near, far = (
        observation(scale * means, torch.zeros(3, dtype=torch.float64)) for scale in (1.0, 3.0)
    )
    torch.testing.assert_close(encoded_observation(near, False), encoded_observation(far, False))
    assert not torch.allclose(encoded_observation(near), encoded_observation(far))


def test_a_decoder_learns_a_colour_that_changes_with_distance() -> None:
    scene = Scene(trained=False)
    optimiser = torch.optim.Adam(scene.decoder.parameters(), lr=0.01)
    near, far = CENTRE, CENTRE - torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    losses = []
    for _ in range(150):
        first, second = (scene.residuals(centre=centre)[:, 6:] for centre in (near, far))
        loss = ((first - 0.2) ** 2 + (second + 0.2) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.05 * losses[0]
