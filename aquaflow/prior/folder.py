"""A prior on disk: ``encoder.onnx``, ``decoder.onnx``, and its card, ``prior.json``."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, model_validator

from aquaflow.base.errors import InputError, path_of_key, words_of
from aquaflow.base.errors.regular_file import sha256_of_stream
from aquaflow.config.stage import StageConfig
from aquaflow.prior.contract import RangeUnit

# --------------------------------------------------------------------------------------------------
# What a monocular depth network takes and gives, as the card of its folder states it.

Measure = Literal["depth", "inverse_depth", "log_depth"]
Unit = Literal["metres", "unknown", "affine"]
ConfidenceKind = Literal["weight", "sigma", "log_variance"]
Channels = Literal["rgb", "bgr"]
Triple = tuple[float, float, float]

NETWORK = "network.onnx"
"""File of the network."""
IMAGENET_MEAN: Triple = (0.485, 0.456, 0.406)
"""Of red, green and blue in [0, 1], which most networks expect."""
IMAGENET_STD: Triple = (0.229, 0.224, 0.225)
"""As IMAGENET_MEAN."""
RELATIVE_ERROR = 0.15
"""Where nothing is known: the relative error of good networks is 5 to 10 % in air
(arXiv:2406.09414, Tables 2 and 10), and water is not what they were trained on."""

UNITS: dict[Unit, RangeUnit] = {"metres": "shared", "unknown": "own", "affine": "affine"}
"""What each unit means for two pictures."""


class DepthCard(StageConfig):
    """Depth along the optical axis, of every pixel or of cells that cover the picture evenly."""

    input: str
    """Name; [1, 3, h, w] or [1, 1, 3, h, w]."""
    output: str
    """Name; one number for each pixel or cell."""
    multiple_px: int = Field(ge=1)
    """Of which the sides of pictures are multiples; also the cell of the network's own."""
    mean: Triple = IMAGENET_MEAN
    """Subtracted from channels in [0, 1], in the network's order of them."""
    std: Triple = IMAGENET_STD
    """Channels are divided by it after that."""
    channels: Channels = "rgb"
    measure: Measure
    unit: Unit
    """metres; unknown: up to scale; affine: inverse depth up to scale and shift."""
    relative_error: float = Field(RELATIVE_ERROR, gt=0.0, le=2.0)
    """1 sigma of the depth; with a confidence of kind weight, that at confidence 1."""
    confidence: str | None = None
    """Name of the output; None: it has none."""
    confidence_kind: ConfidenceKind = "weight"
    """weight: the error falls as 1 / confidence; sigma: relative error; log_variance: of the
    logarithm of depth."""

    @model_validator(mode="after")
    def _is_possible(self) -> DepthCard:
        if self.unit == "affine" and self.measure != "inverse_depth":
            raise ValueError("unit affine is of inverse_depth only")
        if min(self.std) <= 0.0:
            raise ValueError("std must be positive")
        return self


# --------------------------------------------------------------------------------------------------
# The folder of a prior.

CARD = "prior.json"
"""Names the network, its inputs and its licence."""
ENCODER, DECODER = "encoder.onnx", "decoder.onnx"
"""Files of the network."""


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
            f"{path}: {where} {words_of(first['msg'])}; export the prior again"
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
    """SHA-256 of a file of any size."""
    with path.open("rb") as file:
        return sha256_of_stream(file)
