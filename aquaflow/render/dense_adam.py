"""Adam of a few small tensors that all move at every step: the water's, the decoder's weights.

The arithmetic is torch's own (``torch.optim.adam.adam``), and so are its results to the bit. The
optimiser classes around it load torch's compiler when the first one is constructed: a second and
72 MB in the middle of a dive, at its first keyframe.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.optim.adam import adam

STEP, FIRST, SECOND = "step", "exp_avg", "exp_avg_sq"
"""Parts of a tensor's state, as torch names them: the count of its steps, which stays on the host,
and the two moments."""


class DenseAdam:
    """Steps each tensor that has a gradient, as ``torch.optim.Adam`` does."""

    def __init__(
        self,
        groups: Sequence[Mapping[str, Any]],
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        """``groups``: each with its ``params``, tensors of any shape, and their rate ``lr``."""
        self._groups = [list(group["params"]) for group in groups]
        self.rates = [float(group["lr"]) for group in groups]
        """Of each group; may be changed between steps."""
        self._betas, self._eps = betas, eps
        self.tensors: list[Tensor] = [tensor for group in self._groups for tensor in group]
        self.state: dict[int, dict[str, Tensor]] = {}
        """By the tensor's place in ``tensors``; nothing before its first step."""

    @torch.no_grad()
    def step(self) -> None:
        """Move by the gradients that the tensors have now."""
        first = 0
        for group, rate in zip(self._groups, self.rates, strict=True):
            moved = [i for i, tensor in enumerate(group, first) if tensor.grad is not None]
            first += len(group)
            if moved:
                self._step(moved, rate)

    def _step(self, moved: list[int], rate: float) -> None:
        tensors = [self.tensors[i] for i in moved]
        states = [self._state_of(i) for i in moved]
        adam(
            tensors,
            [tensor.grad for tensor in tensors if tensor.grad is not None],
            [state[FIRST] for state in states],
            [state[SECOND] for state in states],
            [],
            [state[STEP] for state in states],
            amsgrad=False,
            beta1=self._betas[0],
            beta2=self._betas[1],
            lr=rate,
            weight_decay=0.0,
            eps=self._eps,
            maximize=False,
        )

    def _state_of(self, i: int) -> dict[str, Tensor]:
        if i not in self.state:
            tensor = self.tensors[i]
            zeros = {name: torch.zeros_like(tensor.detach()) for name in (FIRST, SECOND)}
            self.state[i] = {STEP: torch.tensor(0.0), **zeros}
        return self.state[i]

    def forget_gradients(self) -> None:
        """Gradients of all its tensors."""
        for tensor in self.tensors:
            tensor.grad = None
