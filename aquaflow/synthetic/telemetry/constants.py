"""The errors of the instruments that are drawn once and stay for the whole dive."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from aquaflow.synthetic.config import SyntheticConfig
from aquaflow.synthetic.streams import instrument_stream

__all__ = ["Constants", "draw_constants"]


@dataclass(frozen=True)
class Constants:
    """One draw of every constant error; what a perfect estimator would find."""

    dvl_scale: float = 0.0
    """Relative: measured velocity = (1 + dvl_scale) times the true one."""

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, by name."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}


def draw_constants(config: SyntheticConfig) -> Constants:
    """The constants of a dive: another seed draws others, another noise only scales them."""
    rng = instrument_stream(config.seed, "constants")
    noise = config.telemetry
    return Constants(dvl_scale=noise.dvl_scale_sigma * float(rng.standard_normal()))
