"""What a monocular depth network takes and gives, as the card of its folder states it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from aquaflow.config.stage import StageConfig
from aquaflow.prior.contract import RangeUnit

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
