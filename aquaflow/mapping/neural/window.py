"""A window of steps of the optimiser that share one trunk, each on its own view.

The window's gradients meet in the trunk's output; when it ends they go through the trunk at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from aquaflow.mapping.neural.decode import in_picture
from aquaflow.mapping.neural.decoder import Trunk
from aquaflow.mapping.neural.neural_field import NeuralField, camera_centre
from aquaflow.render.views import View


@dataclass
class Window:
    """A trunk, and the views that still have to be decoded from it."""

    whole: Trunk
    """From features and weights on."""
    hidden: Tensor
    """[P, d] its output as a leaf; gathers the gradient of the window's views."""
    local: Tensor
    """[N, F_l] leaf."""
    shared: Tensor
    """[G, F_g] leaf."""
    views: list[tuple[View, Tensor]]
    """Each with the Gaussians [N] bool that it shows."""

    @staticmethod
    def opened(field: NeuralField, views: Sequence[View]) -> Window:
        """The window of ``views``; if the trunk takes an observation, it is the first one's."""
        means = field.gaussians.means
        seen = [in_picture(means, each, each.viewmat()) for each in views]
        local = field.local.detach().requires_grad_()
        shared = field.shared.detach().requires_grad_()
        centre = camera_centre(views[0].viewmat())
        trunk = field.trunk(field.context(seen), centre, (local, shared))
        hidden = trunk.hidden.detach().requires_grad_()
        return Window(trunk, hidden, local, shared, list(zip(views, seen, strict=True)))

    def has(self, view: View) -> bool:
        """True if ``view`` still has to be decoded."""
        return any(each is view for each, _ in self.views)

    def go_on_to(self, view: View) -> Tensor:
        """[N] bool: what ``view`` shows; steps that were left out before it are passed over."""
        while self.views[0][0] is not view:
            self.views.pop(0)
        return self.views.pop(0)[1]

    @property
    def trunk(self) -> Trunk:
        """What a view is decoded from: its gradient ends in ``hidden``."""
        return Trunk(self.whole.tokens, self.hidden, self.whole.sound)

    def differentiate(self) -> bool:
        """Let the gradient of ``hidden`` reach features and weights; False if there is none."""
        if self.hidden.grad is None:
            return False
        torch.autograd.backward(self.whole.hidden, self.hidden.grad)
        return True
