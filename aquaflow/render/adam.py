"""Adam that steps only the Gaussians that were seen, each at its own count of steps.

Kingma & Ba 2015, row by row: a row that is not visible keeps its parameters and moments, and the
bias correction uses the row's own step count, so a Gaussian's first visible step is a proper first
step.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
import torch
from torch import Tensor

from aquaflow.base.errors import AquaFlowError
from aquaflow.render.library import Library, library_or_none
from aquaflow.render.tensor_address import pointer

LARGEST_GRADIENT = 1e18
"""Larger gradients count as not finite: their square overflows float32."""

SETTLED = 1e-8
"""Bias corrections this close to one are taken as one."""


class _NativeGroup(ctypes.Structure):
    """``AdamGroup`` of native/adam.h."""

    _fields_ = (
        ("param", ctypes.c_void_p),
        ("gradient", ctypes.c_void_p),
        ("first_moment", ctypes.c_void_p),
        ("second_moment", ctypes.c_void_p),
        ("dim", ctypes.c_int32),
        ("learning_rate", ctypes.c_float),
    )


def _with_zeros(
    state: Tensor,  # [N, ...]
    n_new: int,
) -> Tensor:
    """[N + n_new, ...] zeros at the end. Those of a whole map on the CPU take no memory until they
    are written: a finished map that is read to be drawn never has a step."""
    if len(state) or state.device.type != "cpu":
        return torch.cat([state, state.new_zeros(n_new, *state.shape[1:])])
    kind = np.dtype(str(state.dtype).removeprefix("torch."))
    return torch.from_numpy(np.zeros((n_new, *state.shape[1:]), kind))


class SelectiveAdam:
    """Optimiser over named tensors that share their rows: [N, ...] each, float32."""

    def __init__(
        self,
        groups: Mapping[str, tuple[Tensor, float]],  # each tensor [N, ...]
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
        threads: int | None = None,
    ) -> None:
        """``groups``: name -> (tensor, learning rate). Tensors are updated in place.

        Raises AquaFlowError when the tensors differ in rows or are not contiguous float32.
        """
        if not groups:
            raise AquaFlowError("SelectiveAdam has no tensors; pass at least one group.")
        self.params = {name: tensor for name, (tensor, _) in groups.items()}
        self.learning_rates = {name: rate for name, (_, rate) in groups.items()}
        self.betas, self.eps = betas, eps
        self.threads = threads if threads is not None else torch.get_num_threads()
        first = next(iter(self.params.values()))
        self._skipped = torch.zeros((), dtype=torch.int64, device=first.device)
        self.steps = torch.zeros(len(first), dtype=torch.int32, device=first.device)
        self.first_moments = {k: torch.zeros_like(v.detach()) for k, v in self.params.items()}
        self.second_moments = {k: torch.zeros_like(v.detach()) for k, v in self.params.items()}
        self.bias = _bias_table(betas, first.device)
        """[T, 2] corrections of the first and second moment at step 1 to T; one afterwards."""
        self._check_params(self.params)

    def step(
        self,
        visible: Tensor,  # [N] bool
        grads: Mapping[str, Tensor],  # each [N, ...]
    ) -> None:
        """Step the visible rows of the tensors named in ``grads``.

        A row with a gradient that is not finite in any tensor is left as it is, in all tensors,
        and counted in ``skipped``.
        """
        self._check_step(visible, grads)
        library = library_or_none() if self.steps.device.type == "cpu" else None
        with torch.no_grad():
            if library is not None:
                self._skipped += self._step_native(library, visible, grads)
                return
            sound = sound_rows(grads, len(visible))
            self._skipped += (visible & ~sound).sum()
            self._step_torch(visible & sound, grads)

    @property
    def skipped(self) -> int:
        """Visible rows not stepped so far because a gradient was not finite."""
        return int(self._skipped)

    def count_skipped(self, rows: int) -> None:
        """Rows that a step elsewhere, of the same state, left as they were."""
        self._skipped += rows

    def extend(self, n_new: int) -> None:
        """Add state for ``n_new`` rows at the end, at step 0; then ``bind`` the grown tensors."""
        self._replace(lambda state: _with_zeros(state, n_new))

    def extend_with(
        self,
        steps: Tensor,  # [M]
        first: Mapping[str, Tensor],  # each [M, ...]
        second: Mapping[str, Tensor],  # each [M, ...]
    ) -> None:
        """Add rows at the end in the state in which they were kept elsewhere; then ``bind``."""
        moments = [
            {name: torch.cat([moment, new[name]]) for name, moment in old.items()}
            for old, new in ((self.first_moments, first), (self.second_moments, second))
        ]
        self.steps = torch.cat([self.steps, steps])
        self.first_moments, self.second_moments = moments

    def keep(
        self,
        mask: Tensor,  # [N] bool
    ) -> None:
        """Drop the state of rows where ``mask`` is False; then ``bind`` the pruned tensors."""
        rows = torch.nonzero(mask)[:, 0]  # once for all tensors
        self._replace(lambda state: state[rows])

    def _replace(self, change: Callable[[Tensor], Tensor]) -> None:
        """All state at once, when all of it is made: a failure leaves it as it was."""
        first = {name: change(moment) for name, moment in self.first_moments.items()}
        second = {name: change(moment) for name, moment in self.second_moments.items()}
        self.steps, self.first_moments, self.second_moments = change(self.steps), first, second

    def bind(
        self,
        params: Mapping[str, Tensor],  # each [N, ...]
    ) -> None:
        """Replace the tensors named in ``params``; raises AquaFlowError if they do not fit."""
        bound = {**self.params, **params}
        self._check_params(bound)
        self.params = bound

    def _check_params(
        self,
        params: Mapping[str, Tensor],  # each [N, ...]
    ) -> None:
        for name, tensor in params.items():
            moment = self.first_moments.get(name)
            if moment is None or tensor.shape != moment.shape or len(tensor) != len(self.steps):
                raise AquaFlowError(
                    f"SelectiveAdam tensor {name} has shape {tuple(tensor.shape)}, not the "
                    f"{len(self.steps)} rows of the state; call extend or keep before bind."
                )
            if tensor.device != self.steps.device:
                raise AquaFlowError(
                    f"SelectiveAdam tensor {name} is on {tensor.device} and its state on "
                    f"{self.steps.device}; keep a map and its optimiser on one device."
                )
            if tensor.dtype != torch.float32 or not tensor.is_contiguous():
                raise AquaFlowError(
                    f"SelectiveAdam tensor {name} is not contiguous float32; pass a plain tensor."
                )

    def _check_step(
        self,
        visible: Tensor,  # [N] bool
        grads: Mapping[str, Tensor],  # each [N, ...]
    ) -> None:
        self._check_params(self.params)  # a caller may have forgotten to bind after keep
        if visible.dtype != torch.bool or tuple(visible.shape) != (len(self.steps),):
            raise AquaFlowError(
                f"SelectiveAdam input visible is {visible.dtype} {tuple(visible.shape)}; "
                f"pass bool ({len(self.steps)},)."
            )
        for name, gradient in grads.items():
            if name not in self.params or gradient.shape != self.params[name].shape:
                raise AquaFlowError(
                    f"SelectiveAdam gradient {name} with shape {tuple(gradient.shape)} fits no "
                    "tensor; name and shape it as in the groups."
                )

    def _step_native(
        self,
        library: Library,
        visible: Tensor,  # [N] bool
        grads: Mapping[str, Tensor],  # each [N, ...]
    ) -> int:
        seen = visible.contiguous()
        plain = {name: g.detach().to(torch.float32).contiguous() for name, g in grads.items()}
        params = {name: self.params[name].detach() for name in plain}  # alive during the call
        groups = (_NativeGroup * len(plain))()
        for group, (name, gradient) in zip(groups, plain.items(), strict=True):
            group.param = pointer(params[name])
            group.gradient = pointer(gradient)
            group.first_moment = pointer(self.first_moments[name])
            group.second_moment = pointer(self.second_moments[name])
            group.dim = gradient[0].numel() if len(gradient) else 0
            group.learning_rate = self.learning_rates[name]
        return library.call(
            "aq_adam_step",
            len(plain),
            ctypes.addressof(groups),
            len(self.steps),
            pointer(seen, torch.bool),
            pointer(self.steps, torch.int32),
            *self.betas,
            self.eps,
            pointer(self.bias),
            len(self.bias),
            self.threads,
        )

    def _step_torch(
        self,
        rows: Tensor,  # [N] bool
        grads: Mapping[str, Tensor],  # each [N, ...]
    ) -> None:
        bias = self.bias[self.steps.long().clamp(max=len(self.bias) - 1)]
        self.steps += rows
        kernel = fused_kernel(self.steps.device.type)
        step = step_rows if kernel is None else partial(step_rows_fused, kernel)
        for name, gradient in grads.items():
            parameter, rate = self.params[name].detach(), self.learning_rates[name]
            moments = (self.first_moments[name], self.second_moments[name])
            moved = Moved(parameter, gradient.to(torch.float32), *moments, rate)
            step(moved, rows, bias, self.betas, self.eps)


def sound_rows(
    grads: Mapping[str, Tensor],  # each [rows, ...]
    rows: int,
) -> Tensor:
    """[rows] bool: every gradient of the row is a number, and its square is one too."""
    sound = [
        (g.abs() < LARGEST_GRADIENT).reshape(rows, math.prod(g.shape[1:])).all(1)
        for g in grads.values()
    ]
    return torch.stack(sound).all(0)


def _bias_table(betas: tuple[float, float], device: torch.device) -> Tensor:
    """[T, 2]: 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t) for t = 1 ... T; one afterwards."""
    beta1, beta2 = betas
    slowest = min(max(beta1, beta2, 0.5), 1 - 1e-5)
    length = math.ceil(math.log(SETTLED) / math.log(slowest))
    t = torch.arange(1, length + 1, dtype=torch.float64, device=device)
    return torch.stack([1 / (1 - beta1**t), (1 - beta2**t).rsqrt()], 1).float().contiguous()


# --------------------------------------------------------------------------------------------------
# One step of Adam on chosen rows of tensors, each row at its own count of steps, in torch.
#
# The rows are a mask and never become indices, whose number a GPU would have to be asked for.

Kernel = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, float, float, float, float], None]
"""``adam(param, param_grad, exp_avg, exp_avg_sq, valid, lr, b1, b2, eps)`` of gsplat: changes the
first, third and fourth in the rows that are ``valid``, without bias correction."""


@dataclass(frozen=True)
class Moved:
    """A tensor that takes a step; all but the gradient are changed in place."""

    parameter: Tensor
    """[N, ...]"""
    gradient: Tensor
    """[N, ...]"""
    first_moment: Tensor
    """[N, ...]"""
    second_moment: Tensor
    """[N, ...]"""
    learning_rate: float


def step_rows(
    moved: Moved,
    rows: Tensor,  # [N] bool, those to step
    bias: Tensor,  # [N, 2] 1 / (1 - beta1^t), 1 / sqrt(1 - beta2^t) of each row
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Kingma & Ba 2015, Algorithm 1; other rows stay as they are."""
    (beta1, beta2), first, second = betas, moved.first_moment, moved.second_moment
    shape = (-1, *[1] * (first.dim() - 1))
    chosen, (b1, b2) = rows.view(shape), (each.view(shape) for each in bias.unbind(1))
    g = torch.where(chosen, moved.gradient, 0.0)
    m = beta1 * first + (1 - beta1) * g
    v = beta2 * second + (1 - beta2) * g * g
    change = moved.learning_rate * b1 * m / (v.sqrt() * b2 + eps)
    first.copy_(torch.where(chosen, m, first))
    second.copy_(torch.where(chosen, v, second))
    moved.parameter.sub_(torch.where(chosen, change, 0.0))


def step_rows_fused(
    kernel: Kernel,
    moved: Moved,
    rows: Tensor,  # [N] bool
    bias: Tensor,  # [N, 2]
    betas: tuple[float, float],
    eps: float,
) -> None:
    """The same by gsplat's kernel, whose step from zero is then corrected for its bias.

    ``eps`` is added before the correction, not after it; at 1e-15 no gradient is small enough for
    that to show.
    """
    if moved.parameter.numel() == 0:
        return  # the kernel divides by the number of rows
    change, gradient = torch.zeros_like(moved.parameter), moved.gradient.contiguous()
    kernel(
        change, gradient, moved.first_moment, moved.second_moment, rows, moved.learning_rate,
        *betas, eps,
    )  # fmt: skip
    corrected = (bias[:, 0] / bias[:, 1]).view(-1, *[1] * (change.dim() - 1))
    moved.parameter.addcmul_(change, corrected)


@lru_cache
def fused_kernel(device_type: str) -> Kernel | None:
    """gsplat's, where the device is CUDA's and gsplat has kernels for it; else None."""
    from aquaflow.render import gsplat

    if device_type != "cuda" or not gsplat.available():
        return None
    from gsplat.cuda._wrapper import adam

    kernel: Kernel = adam
    return kernel
