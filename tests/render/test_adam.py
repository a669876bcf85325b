"""Selective Adam against a reference written one row at a time."""

from __future__ import annotations

import inspect
import math

import pytest
import torch
from torch import Tensor

from aquaflow.base.errors import AquaFlowError
from aquaflow.render import gsplat
from aquaflow.render.adam import SelectiveAdam, fused_kernel


class OneRow:
    """Adam of a single parameter row, in Python floats."""

    def __init__(self, values: list[float]) -> None:
        self.p, self.m, self.v = values, [0.0] * len(values), [0.0] * len(values)
        self.t = 0

    def step(self, gradient: list[float], rate: float, eps: float) -> None:
        self.t += 1
        for i, g in enumerate(gradient):
            self.m[i] = 0.9 * self.m[i] + 0.1 * g
            self.v[i] = 0.999 * self.v[i] + 0.001 * g * g
            m_hat = self.m[i] / (1 - 0.9**self.t)
            v_hat = self.v[i] / (1 - 0.999**self.t)
            self.p[i] -= rate * m_hat / (math.sqrt(v_hat) + eps)


def tensors(n: int = 40) -> dict[str, tuple[Tensor, float]]:
    rng = torch.Generator().manual_seed(0)
    return {
        "means": (torch.randn(n, 3, generator=rng), 1e-2),
        "opacities": (torch.randn(n, generator=rng), 5e-2),
        "features": (torch.randn(n, 2, 5, generator=rng), 1e-3),
    }


def gradients(groups: dict[str, tuple[Tensor, float]], seed: int) -> dict[str, Tensor]:
    rng = torch.Generator().manual_seed(seed)
    return {name: torch.randn(t.shape, generator=rng) for name, (t, _) in groups.items()}


def gsplats_kernel(
    param: Tensor,
    param_grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    valid: Tensor,
    lr: float,
    b1: float,
    b2: float,
    eps: float,
) -> None:
    """What gsplat's ``adam_kernel`` does, row by row."""
    assert param.is_contiguous()
    assert param_grad.is_contiguous()
    assert len(valid) == len(param) > 0
    g, m, v = param_grad[valid], exp_avg[valid], exp_avg_sq[valid]
    m, v = b1 * m + (1 - b1) * g, b2 * v + (1 - b2) * g * g
    param[valid] += -lr * m / (v.sqrt() + eps)
    exp_avg[valid], exp_avg_sq[valid] = m, v


@pytest.fixture(params=["native", "torch", "gsplat"])
def implementation(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param != "native":
        monkeypatch.setattr("aquaflow.render.adam.library_or_none", lambda: None)
    if request.param == "gsplat":
        monkeypatch.setattr("aquaflow.render.adam.fused_kernel", lambda device: gsplats_kernel)
    return str(request.param)


@pytest.mark.usefixtures("implementation")
def test_visible_rows_follow_adam_at_their_own_step_count() -> None:
    groups = tensors()
    rows = {k: [OneRow(r.flatten().tolist()) for r in t] for k, (t, _) in groups.items()}
    adam = SelectiveAdam(groups)
    for it in range(12):
        visible = torch.rand(40, generator=torch.Generator().manual_seed(100 + it)) > 0.4
        grads = gradients(groups, it)
        adam.step(visible, grads)
        assert adam.skipped == 0
        for name, (_, rate) in groups.items():
            for i in torch.nonzero(visible)[:, 0].tolist():
                rows[name][i].step(grads[name][i].flatten().tolist(), rate, adam.eps)
    for name, (tensor, _) in groups.items():
        wanted = torch.tensor([row.p for row in rows[name]]).view(tensor.shape)
        assert torch.allclose(tensor, wanted, rtol=1e-5, atol=1e-6)


@pytest.mark.usefixtures("implementation")
def test_the_first_visible_step_has_the_length_of_the_learning_rate() -> None:
    groups = tensors()
    before = groups["means"][0].clone()
    adam = SelectiveAdam(groups)
    late = torch.zeros(40, dtype=torch.bool)
    late[7] = True
    for it in range(50):
        adam.step(~late, gradients(groups, it))
    assert torch.equal(groups["means"][0][7], before[7])
    adam.step(late, gradients(groups, 99))
    assert torch.allclose((groups["means"][0][7] - before[7]).abs(), torch.tensor(1e-2), rtol=1e-4)


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e30])
def test_a_row_with_a_gradient_that_is_not_finite_is_left_alone_and_counted(bad: float) -> None:
    groups = tensors()
    before = {name: t.clone() for name, (t, _) in groups.items()}
    adam = SelectiveAdam(groups)
    grads = gradients(groups, 0)
    grads["features"][5, 1, 2] = bad
    adam.step(torch.ones(40, dtype=torch.bool), grads)
    assert adam.skipped == 1
    assert adam.steps[5] == 0
    for name, (tensor, _) in groups.items():
        assert torch.equal(tensor[5], before[name][5])
        assert not torch.equal(tensor[6], before[name][6])
        assert tensor.isfinite().all()


@pytest.mark.usefixtures("implementation")
def test_state_follows_growth_and_pruning() -> None:
    groups = tensors()
    adam = SelectiveAdam(groups)
    adam.step(torch.ones(40, dtype=torch.bool), gradients(groups, 0))
    kept = torch.arange(40) % 2 == 0
    moment = adam.first_moments["means"][kept]
    adam.keep(kept)
    adam.extend(3)
    grown = {k: torch.cat([t[kept], torch.zeros(3, *t.shape[1:])]) for k, (t, _) in groups.items()}
    adam.bind(grown)
    assert torch.equal(adam.first_moments["means"][:20], moment)
    assert adam.steps.tolist() == [1] * 20 + [0] * 3
    grads = {name: torch.ones_like(t) for name, t in grown.items()}
    adam.step(torch.ones(23, dtype=torch.bool), grads)
    assert torch.allclose(grown["means"][20:], torch.tensor(-1e-2), rtol=1e-4)


def stepped(threads: int) -> tuple[dict[str, Tensor], Tensor]:
    """A map of more than one chunk and thread, after steps that see parts of it."""
    rows = 20_000
    groups = tensors(rows)
    adam = SelectiveAdam(groups, threads=threads)
    rng = torch.Generator().manual_seed(9)
    for it in range(3):
        views = torch.rand(rows // 100, generator=rng) < 0.4
        seen = views.repeat_interleave(100) & (torch.rand(rows, generator=rng) < 0.7)
        grads = gradients(groups, it)
        broken = torch.randint(rows, (5,), generator=rng)
        grads["means"][broken, 1] = float("nan")
        before = adam.skipped
        adam.step(seen, grads)
        assert adam.skipped - before == int(seen[broken].sum())
    return {name: tensor for name, (tensor, _) in groups.items()}, adam.steps


def test_the_result_does_not_depend_on_the_number_of_threads() -> None:
    wanted, wanted_steps = stepped(1)
    for threads in (2, 5):
        got, steps = stepped(threads)
        assert torch.equal(steps, wanted_steps)
        assert all(torch.equal(got[name], wanted[name]) for name in wanted)


@pytest.mark.parametrize("kernel", [None, gsplats_kernel])
def test_compiled_torch_and_gsplats_kernel_take_the_same_steps(
    monkeypatch: pytest.MonkeyPatch, kernel: object
) -> None:
    got, steps = stepped(2)
    monkeypatch.setattr("aquaflow.render.adam.library_or_none", lambda: None)
    monkeypatch.setattr("aquaflow.render.adam.fused_kernel", lambda device: kernel)
    wanted, wanted_steps = stepped(2)
    assert torch.equal(steps, wanted_steps)
    for name in wanted:
        assert torch.allclose(got[name], wanted[name], rtol=1e-5, atol=1e-6)


@pytest.mark.usefixtures("implementation")
def test_leaf_tensors_that_require_gradients_are_stepped_in_place() -> None:
    leaf = torch.zeros(4, 3, requires_grad=True)
    adam = SelectiveAdam({"means": (leaf, 0.1)})
    adam.step(torch.ones(4, dtype=torch.bool), {"means": torch.ones(4, 3)})
    assert torch.allclose(leaf, torch.tensor(-0.1), rtol=1e-4)


def test_binding_tensors_of_another_length_is_refused() -> None:
    adam = SelectiveAdam(tensors())
    with pytest.raises(AquaFlowError, match="means"):
        adam.bind({"means": torch.zeros(41, 3)})
    with pytest.raises(AquaFlowError, match="visible"):
        adam.step(torch.ones(41, dtype=torch.bool), {})


def test_gsplats_kernel_has_the_signature_that_it_is_called_with() -> None:
    wrapper = pytest.importorskip("gsplat.cuda._wrapper", reason="gsplat is not installed")
    installed = inspect.signature(wrapper.adam).parameters
    assert list(installed) == list(inspect.signature(gsplats_kernel).parameters)


def test_without_cuda_there_is_no_fused_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gsplat, "available", lambda: False)
    fused_kernel.cache_clear()
    assert fused_kernel("cpu") is None
    assert fused_kernel("cuda") is None
    fused_kernel.cache_clear()


def test_an_empty_map_takes_a_step_of_any_kind(
    implementation: str,
) -> None:
    adam = SelectiveAdam({"means": (torch.zeros(0, 3), 1e-2)})
    adam.step(torch.zeros(0, dtype=torch.bool), {"means": torch.zeros(0, 3)})
    assert adam.skipped == 0
