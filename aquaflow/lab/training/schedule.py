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
    hold: int = 0
    """Steps at the highest rate before the cosine begins: a run whose length is not known yet holds
    it, and is resumed with the length that there turned out to be time for."""

    def rate(self, step: int) -> float:
        """Of the optimiser's step number ``step``, counted from 0."""
        if step < self.warm_up:
            return self.highest * (step + 1) / self.warm_up
        begins = self.warm_up + self.hold
        share = (step - begins) / max(self.steps - 1 - begins, 1)
        share = min(max(share, 0.0), 1.0)
        return self.lowest + (self.highest - self.lowest) * 0.5 * (1.0 + math.cos(math.pi * share))
