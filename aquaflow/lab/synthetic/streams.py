"""Streams of random numbers: one for each part of a dive.

What one part draws never changes another part: more noise on the depth gives the same pictures.
"""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

import numpy as np

Part: TypeAlias = Literal[
    "terrain", "objects", "colours", "sway", "telemetry", "snow", "sensor", "mounting", "bodies"
]
"""In the order of their streams: a new one comes last, so that the others stay as they are."""

Instrument: TypeAlias = Literal[
    "constants", "depth", "attitude", "angular_rate", "acceleration", "velocity", "altitude",
    "position", "utc_time",
]  # fmt: skip
"""Streams within that of the telemetry, in their order."""


def stream(seed: int, part: Part) -> np.random.Generator:
    """The stream of one part from its start."""
    key = get_args(Part).index(part)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(key,)))


def instrument_stream(seed: int, instrument: Instrument) -> np.random.Generator:
    """The stream of one instrument from its start."""
    key = (get_args(Part).index("telemetry"), get_args(Instrument).index(instrument))
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
