"""The learning rate over a training: a linear start, then half a cosine (paper, Sec. 4)."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Schedule:
    """Rates by step; defaults are those of the paper's fine-tuning."""

    steps: int
    warm_up: int
    """Steps of the linear start."""
    highest: float = 1e-6
    lowest: float = 1e-7

    def rate(self, step: int) -> float:
        """Of the optimiser's step number ``step``, counted from 0."""
        if step < self.warm_up:
            return self.highest * (step + 1) / self.warm_up
        share = (step - self.warm_up) / max(self.steps - 1 - self.warm_up, 1)
        share = min(share, 1.0)
        return self.lowest + (self.highest - self.lowest) * 0.5 * (1.0 + math.cos(math.pi * share))
