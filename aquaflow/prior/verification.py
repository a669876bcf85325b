"""Does a prior say the same on another processor, or in less precision, as on the CPU in 32 bits?

What is compared is what tracking gets: features of two fixed pictures, and descriptors, ranges and
confidences of the pair. Graphics processors and their compilers have given silently wrong results.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import AquaFlowError
from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.describers import describer_in
from aquaflow.prior.example_picture import example_picture
from aquaflow.prior.folder import read_card
from aquaflow.prior.runtime import RuntimeSettings

Array = npt.NDArray[Any]

MOST: dict[str, float] = {"fp32": 2e-3, "fp16": 0.05, "int8": 0.25}
"""Difference, relative to an output's largest value (of logarithms: as it is), that is agreement.
Features are kept in 16 bits, whose roundings are up to 1e-3 apart; numbers of 16 bits err by 5e-4
each, and add up in deep networks; of the shipped 8-bit network 0.1 was measured."""
MOST_UNKNOWN = 0.01
"""Share of numbers that one run knows and the other does not; more is no agreement."""
MOVED_PX = 16
"""Of the second picture over the first."""


def differences(folder: Path, settings: RuntimeSettings) -> dict[str, float]:
    """Largest difference of each output from that on the CPU in 32 bits; infinite where one run
    knows what the other does not.

    Raises:
        InputError: no prior, changed files, or no network of that precision.
        AquaFlowError: the processor or the precision cannot be had.
    """
    expected = _run_network(folder, RuntimeSettings(device="cpu", precision="fp32"))
    found = _run_network(folder, settings)
    return {name: difference(expected[name], found[name], _scale(name)) for name in expected}


def check(name: str, found: dict[str, float], settings: RuntimeSettings) -> None:
    """Nothing, if each of the differences is at most that of the precision (``MOST``).

    Raises:
        AquaFlowError: one is larger, or no number.
    """
    most = MOST[settings.precision]
    output, worst = max(found.items(), key=lambda item: np.nan_to_num(item[1], nan=np.inf))
    if not worst <= most:
        raise AquaFlowError(
            f"prior {name} on {settings.device} in {settings.precision} differs from the CPU by "
            f"{worst:.1e} in {output}, more than {most:.1e}; use another device or precision"
        )


def difference(
    expected: Array,  # [...]
    found: Array,  # [...] as expected
    scale: float | None = None,
) -> float:
    """Largest difference over ``scale``, or over the largest expected value."""
    if expected.shape != found.shape:
        return float("inf")
    known = np.isfinite(expected)
    both = known & np.isfinite(found)
    if (known != np.isfinite(found)).mean() > MOST_UNKNOWN or not both.any():
        return float("inf")
    largest = float(np.abs(expected[both]).max()) if scale is None else scale
    distance = np.abs(expected[both].astype(np.float64) - found[both].astype(np.float64))
    return float(distance.max()) / max(largest, float(np.finfo(np.float32).tiny))


def _run_network(folder: Path, settings: RuntimeSettings) -> dict[str, Array]:
    """Outputs by name."""
    card, describer = read_card(folder), describer_in(folder, settings)
    wide = example_picture(card.height, card.width + MOVED_PX)
    pictures = [np.ascontiguousarray(wide[:, :-MOVED_PX]), np.ascontiguousarray(wide[:, MOVED_PX:])]
    a, b = (describer.features(describer.fit(picture)) for picture in pictures)
    width, height = card.width, card.height
    camera = CameraModel(width, height, width, width, 0.5 * width, 0.5 * height)
    pair = describer.compare(a, b, camera, camera)
    said: dict[str, Array] = {"features_a": a, "features_b": b}
    if pair.cells is not None:
        said |= {"cells_a": pair.cells[0], "cells_b": pair.cells[1]}
    for view, range_ in (("a", pair.range_a), ("b", pair.range_b)):
        said[f"log_range_{view}"] = range_.log_range
        said[f"log_sigma_{view}"] = 0.5 * np.log(range_.variance)
    return said if pair.confidence is None else said | {"confidence": pair.confidence}


def _scale(output: str) -> float | None:
    """Differences of logarithms are relative already."""
    return 1.0 if output.startswith("log_") else None
