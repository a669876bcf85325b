"""A prior on disk: ``encoder.onnx``, ``decoder.onnx``, and ``prior.json`` to vouch for them."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from aquaflow.base.errors import InputError, path_of_key
from aquaflow.config.stage import StageConfig
from aquaflow.prior.depth_card import DepthCard

CARD = "prior.json"
"""Names the network, its inputs and its licence."""
ENCODER, DECODER = "encoder.onnx", "decoder.onnx"
"""Files of the network."""
READ_BYTES = 1 << 20
"""Read at a time for the checksum."""


class PriorCard(StageConfig):
    """What a prior is, where it comes from, and how its files are known to be whole."""

    name: Literal["compact", "depth", "mast3r", "oracle"]
    width: int
    """px of the pictures it takes"""
    height: int
    """px"""
    descriptor: int
    """Numbers of a pixel's descriptor."""
    metric: bool
    """True if its pointmaps are in metres."""
    licence: str
    opset: int
    files: dict[str, str]
    """sha256 of each file of the folder."""
    parity: dict[str, float]
    """Largest difference of each output from torch's, relative to that output's largest value."""
    range_variance_factor: float = 1.0
    """By which the variance of the learned range is multiplied: fitted on held-out pairs."""
    training: dict[str, Any] | None = None
    """Seeds, steps, hardware and validation figures of the weights; None: not trained by us."""
    depth: DepthCard | None = None
    """Of a network that gives depth: what it takes and gives."""


def write_card(folder: Path, card: PriorCard) -> None:
    """Write ``card`` into the folder of the files it describes."""
    (folder / CARD).write_text(card.model_dump_json(indent=2) + "\n")


def read_card(folder: Path) -> PriorCard:
    """The card of ``folder``, after every file was compared with its sha256.

    Raises:
        InputError: no card, a card that does not parse, or a file that is missing or changed.
    """
    path = folder / CARD
    if not path.is_file():
        raise InputError(f"{folder} is no prior: there is no {CARD}; give an exported folder")
    try:
        card = PriorCard.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        where = path_of_key(first["loc"]) or "the file"
        raise InputError(
            f"{path}: {where} {first['msg'].lower()}; export the prior again"
        ) from error
    for name, expected in card.files.items():
        if Path(name).name != name:
            raise InputError(f"{path} names {name}, outside its folder; export the prior again")
        if not (folder / name).is_file():
            raise InputError(f"{folder} lacks {name}; export the prior again")
        if sha256_of(folder / name) != expected:
            raise InputError(f"{folder / name} is not the file that was exported; export it again")
    return card


def sha256_of(path: Path) -> str:
    """Of a file of any size."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(READ_BYTES):
            digest.update(block)
    return digest.hexdigest()
