"""A user's depth network as a prior folder: what it takes and gives, a test run, and its proof."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from aquaflow.base.errors import AquaFlowError, ArgumentError, InputError, first_line, words_of
from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.depth_describer import DepthDescriber
from aquaflow.prior.describers import describer_in
from aquaflow.prior.folder import NETWORK, DepthCard, PriorCard, read_card, sha256_of, write_card
from aquaflow.prior.network import Picture
from aquaflow.prior.runtime import NetworkSession, RuntimeSettings

WEIGHTS_BESIDE = ("{}_data", "{}.data")
"""Names under which exporters write the weights of large networks, next to the network."""
LEAST_KNOWN = 0.5
"""Of the test picture's pixels, that must get a depth."""
CPU = RuntimeSettings(device="cpu")


@dataclass(frozen=True)
class Described:
    """A folder that was written, and how its test run went."""

    card: PriorCard
    width: int
    """px of the picture that the network was given"""
    height: int
    seconds: float
    """Of the run, on one core."""
    known: float
    """Share of the pixels that got a depth."""


def names_of(network: Path) -> tuple[dict[str, tuple[int | str, ...]], list[str]]:
    """Inputs with their shapes, and outputs.

    Raises:
        InputError: the file is missing or no network.
    """
    if not network.is_file():
        raise InputError(f"{network} is no file; give an ONNX file")
    session = NetworkSession(network, CPU)
    return session.inputs, session.outputs


def only(names: list[str], what: str, option: str) -> str:
    """The one that there is.

    Raises:
        InputError: there are several.
    """
    if len(names) != 1:
        raise InputError(f"the network has the {what}s {', '.join(names)}; choose with {option}")
    return names[0]


def depth_card(
    stated: dict[str, Any],  # fields of DepthCard
) -> DepthCard:
    """What the user says of the network.

    Raises:
        ArgumentError: something that is not possible.
    """
    try:
        return DepthCard.model_validate(stated)
    except ValidationError as error:
        first = error.errors()[0]
        option = "".join(f"--{part}: " for part in first["loc"][:1]).replace("_", "-")
        raise ArgumentError(
            f"{option}{words_of(first['msg'])}; see `aquaflow lab prior describe --help`"
        ) from error


def describe(
    network: Path, folder: Path, depth: DepthCard, width: int, height: int, licence: str
) -> Described:
    """Write ``folder`` with a copy of ``network``, for pictures of as many pixels as ``width`` x
    ``height`` (the network's own size if that is fixed).

    Raises:
        InputError: ``folder`` is not empty, or the network does not do what ``depth`` says.
    """
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder} is not empty; give a new folder")
    folder.mkdir(parents=True, exist_ok=True)
    try:
        card = PriorCard(
            name="depth",
            width=width,
            height=height,
            descriptor=0,
            metric=depth.unit == "metres",
            licence=licence,
            opset=0,
            files=_copy(network, folder),
            parity={},
            depth=depth,
        )
        write_card(folder, card)
        return _try_prior(folder, card)
    except BaseException:  # also when interrupted: half a folder would be in the way of the next
        shutil.rmtree(folder)
        raise


def _copy(network: Path, folder: Path) -> dict[str, str]:
    """Checksums of the network and of weights that lie in a file of their own."""
    shutil.copyfile(network, folder / NETWORK)
    names = [NETWORK]
    for pattern in WEIGHTS_BESIDE:
        weights = network.with_name(pattern.format(network.name))
        if weights.is_file():
            shutil.copyfile(weights, folder / weights.name)
            names.append(weights.name)
    return {name: sha256_of(folder / name) for name in names}


def _try_prior(folder: Path, card: PriorCard) -> Described:
    describer = DepthDescriber(folder, CPU)
    picture = describer.fit(example_picture(card.height, card.width))
    height, width = picture.shape[:2]
    before = time.perf_counter()
    try:
        features = describer.features(picture)
    except InputError:
        raise
    except Exception as error:  # onnxruntime's errors share no base of their own
        raise InputError(
            f"the network cannot take a picture of {width} x {height} px ({first_line(error)}); "
            "give --multiple, --width and --height that it takes"
        ) from error
    seconds = time.perf_counter() - before
    known = float(np.isfinite(features).all(-1).mean())
    if known < LEAST_KNOWN:
        raise InputError(
            f"the network gives {100.0 * known:.0f} % of the test picture's pixels a depth; look "
            "at --measure, --unit, --output and --confidence"
        )
    return Described(card, width, height, seconds, known)


# --------------------------------------------------------------------------------------------------
# Does a prior say the same on another processor, or in less precision, as on the CPU in 32 bits?
#
# What is compared is what tracking gets: features of two fixed pictures, and descriptors, ranges
# and confidences of the pair. Graphics processors and their compilers have given silently wrong
# results.

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


# --------------------------------------------------------------------------------------------------
# A picture that networks are tried on: always the same, and with structure of all sizes.

OCTAVES = (4, 8, 16, 32, 64)
"""Patches along the picture's shorter side, each half as strong as the one before."""
CONTRAST = 60.0
"""Grey values of the coarsest; the brightest and darkest of 255 are not reached by most pixels."""


def example_picture(height: int, width: int, seed: int = 0) -> Picture:
    """[height, width, 3]"""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width, 3), np.float32)
    for number, patches in enumerate(OCTAVES):
        side = max(min(height, width) // patches, 1)
        shape = (-(-height // side) + 1, -(-width // side) + 1, 3)
        lattice = rng.normal(size=shape).astype(np.float32)
        octave = cv2.resize(lattice, (width, height), interpolation=cv2.INTER_CUBIC)
        total += np.asarray(octave, dtype=np.float32) / np.float32(2.0**number)
    return np.asarray(np.clip(127.0 + CONTRAST * total, 0.0, 255.0), dtype=np.uint8)
