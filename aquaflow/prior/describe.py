"""A user's depth network as a prior folder: its file, what it takes and gives, and a test run."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from aquaflow.base.errors import InputError, first_line, words_of
from aquaflow.prior.depth_card import NETWORK, DepthCard
from aquaflow.prior.depth_describer import DepthDescriber
from aquaflow.prior.example_picture import example_picture
from aquaflow.prior.folder import PriorCard, sha256_of, write_card
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
        InputError: something that is not possible.
    """
    try:
        return DepthCard.model_validate(stated)
    except ValidationError as error:
        first = error.errors()[0]
        option = "".join(f"--{part}: " for part in first["loc"][:1]).replace("_", "-")
        raise InputError(
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
