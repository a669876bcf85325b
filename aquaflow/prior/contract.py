"""The contract between a two-view prior and the rest of AquaFlow (paper, Eq. 1).

A prior encodes each picture once and decodes pairs of encodings. Later priors replace the classical
one behind these two protocols; nothing above them knows which is running.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel

Float = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

RangeUnit: TypeAlias = Literal["shared", "own", "affine"]
"""shared: the ranges of both pictures of a pair are in one unit; own: each picture's are in a unit
of its own; affine: and their inverse depths are off by a constant of that picture, too."""


@dataclass(frozen=True)
class Keypoints:
    """Local features of one picture, by which places are found again."""

    pixels: Float
    """[M, 2] px, this package's convention."""
    descriptors: Float
    """[M, d]; alike where they are near each other. They do not change when the camera rolls."""


class HasKeypoints(Protocol):
    """A picture by its keypoints alone: an encoding, or what a finished dive kept of one."""

    @property
    def keypoints(self) -> Keypoints:
        """Empty where the picture shows nothing."""
        ...


class Encoding(Protocol):
    """One picture, digested once and kept with its frame."""

    camera: CameraModel

    @property
    def interesting(self) -> Mask:
        """[H, W]: pixels with enough texture that a match may be expected of them."""
        ...

    @property
    def keypoints(self) -> Keypoints:
        """Computed when first asked for; empty where the picture shows nothing."""
        ...


class PairGeometry(Protocol):
    """What a prior knows about the pair (a, b); a is the reference (paper: camera i).

    Everything but the matches is computed when first asked for.
    """

    @property
    def matches(self) -> Float:
        """[H, W, 2] px: where each pixel of a is seen in b."""
        ...

    @property
    def valid(self) -> Mask:
        """[H, W]: the match survived the prior's own check."""
        ...

    @property
    def matches_back(self) -> Float:
        """[H, W, 2] px: where each pixel of b is seen in a."""
        ...

    @property
    def valid_back(self) -> Mask:
        """[H, W]: the match of b's pixel survived the prior's own check."""
        ...

    @property
    def C(self) -> Float:
        """[H, W] confidence of the matches in [0, 1]."""
        ...

    @property
    def X_a(self) -> Float | None:
        """[H, W, 3] pointmap of a in a's own frame (paper: X_i^i) as the prior has it without
        parallax; NaN where unknown, None for a prior that knows none. Scale is the prior's."""
        ...

    @property
    def X_b(self) -> Float | None:
        """[H, W, 3] pointmap of b in b's own frame (paper: X_j^j), as X_a."""
        ...

    @property
    def Q_a(self) -> Float | None:
        """[H, W] point confidence: 1 / relative variance of the range; 0 where unknown."""
        ...

    @property
    def Q_b(self) -> Float | None:
        """[H, W] confidence of X_b, as Q_a."""
        ...

    @property
    def range_unit(self) -> RangeUnit:
        """What X_a and X_b have in common; of no meaning where there are none."""
        ...

    @property
    def D_a(self) -> Float | None:
        """[H, W, d] descriptors; None for a prior that matches without any."""
        ...

    @property
    def D_b(self) -> Float | None:
        """[H, W, d] descriptors of b, as D_a."""
        ...


class Prior(Protocol):
    """A two-view prior; a live run calls it from two threads."""

    name: str
    matching: str
    """What its matches are where none are expected, for metrics.json."""
    ranged: bool
    """True if it knows pointmaps (X, Q) of single pictures or still cameras."""
    metric: bool
    """True if its pointmaps are in metres."""
    unit_sigma: float
    """Relative error of the unit of its pointmaps from one part of a dive to another; infinite
    where each pair has a unit of its own."""

    def encode(
        self,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
        camera: CameraModel,
        mask: Mask | None = None,  # [H, W] True where the scene is seen
    ) -> Encoding:
        """What decoding needs of a picture; once for each picture. Of what is masked, nothing is
        matched."""
        ...

    def decode(
        self,
        a: Encoding,
        b: Encoding,
        predicted: Float | None = None,  # [H, W, 2] px, expected matches of a in b
        alone: bool = False,
    ) -> PairGeometry:
        """What a pair of pictures shows.

        ``alone``: only matches near ``predicted`` are wanted, however few they are, to tell whether
        they explain the pair. Of a scene that repeats itself, others may be more.
        """
        ...

    def pack(self, encoding: Encoding) -> dict[str, npt.NDArray[Any]]:
        """The arrays of an encoding, not copied, for a file; what was not computed is left out."""
        ...

    def unpack(
        self,
        arrays: Mapping[str, npt.NDArray[Any]],  # as from pack
        camera: CameraModel,
    ) -> Encoding:
        """The encoding that ``pack`` took apart, equal in every bit; ``arrays`` become its own."""
        ...

    def warm_up(self) -> None:
        """Do what the first pictures would otherwise wait for; a live run begins with it."""
        ...
