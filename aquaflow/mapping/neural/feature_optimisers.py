"""Adam of a neural field's features, row by row, and of its decoder's weights."""

from __future__ import annotations

import torch
from torch import Tensor

from aquaflow.mapping.neural.neural_field import NeuralField
from aquaflow.mapping.neural.window import Window
from aquaflow.render.adam import SelectiveAdam
from aquaflow.render.dense_adam import DenseAdam


class FeatureOptimisers:
    """A row of state for each Gaussian and each group; rows come and go with them."""

    def __init__(self, field: NeuralField, betas: tuple[float, float]) -> None:
        self.field, self._betas = field, betas
        self.local = self._new("local", field.local)
        self.shared = self._new("shared", field.shared)
        weights = {"params": field.decoder.parameters(), "lr": field.config.rate}
        self.weights = DenseAdam([weights], betas)
        self.skipped = 0
        """Windows whose weights were not stepped, as a gradient was not finite."""

    def _new(
        self,
        name: str,
        features: Tensor,  # [N, F]
    ) -> SelectiveAdam:
        groups = {name: (features, self.field.config.feature_rate)}
        return SelectiveAdam(groups, self._betas, threads=self.field.threads)

    def step(self, window: Window) -> None:
        """One step with the gradient of the window's views."""
        assert window.local.grad is not None
        assert window.shared.grad is not None
        tokens, device = window.whole.tokens, self.field.device
        rows = torch.zeros(len(window.local), dtype=torch.bool, device=device)
        rows[tokens.rows] = True
        groups = torch.zeros(len(window.shared), dtype=torch.bool, device=device)
        groups[tokens.groups] = True
        self.local.step(rows, {"local": window.local.grad})
        self.shared.step(groups, {"shared": window.shared.grad})
        gradients = [w.grad for w in self.field.decoder.parameters() if w.grad is not None]
        finite = [torch.isfinite(gradient).all() for gradient in gradients]
        if bool(torch.stack(finite).all()):
            self.weights.step()
        else:
            self.skipped += 1
        self.forget_gradients()

    def forget_gradients(self) -> None:
        """Drop what the weights were to learn."""
        self.weights.forget_gradients()

    def slow_down(self, factor: float) -> None:
        """Set the learning rates to this share of the configured ones."""
        config = self.field.config
        self.local.learning_rates["local"] = factor * config.feature_rate
        self.shared.learning_rates["shared"] = factor * config.feature_rate
        self.weights.rates[0] = factor * config.rate

    def renew_shared(self) -> None:
        """Begin at step 0 with the groups as they are."""
        self.shared = self._new("shared", self.field.shared)

    def renew_local(self) -> None:
        """Begin at step 0 with the Gaussians as they are."""
        self.local = self._new("local", self.field.local)

    def bind(self) -> None:
        """Use the field's features as they are now; new groups begin at step 0."""
        self.shared.extend(len(self.field.groups) - len(self.shared.steps))
        self.shared.bind({"shared": self.field.shared})
        self.local.bind({"local": self.field.local})
