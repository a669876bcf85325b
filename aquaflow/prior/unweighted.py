"""A prior without its confidence, to find out what C is worth (`aquaflow ablate`)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.contract import Encoding, Float, Mask, PairGeometry, Prior


class UnweightedPair:
    """A pair all of whose valid matches count the same."""

    def __init__(self, pair: PairGeometry) -> None:
        self._pair = pair

    def __getattr__(self, name: str) -> Any:
        return getattr(self._pair, name)

    @cached_property
    def C(self) -> Float:
        return self._pair.valid.astype(np.float32)


class UnweightedPrior:
    """Another prior whose matches all count the same."""

    def __init__(self, prior: Prior) -> None:
        self._prior = prior
        self.name, self.ranged, self.metric = prior.name, prior.ranged, prior.metric
        self.unit_sigma = prior.unit_sigma

    def encode(
        self,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
        camera: CameraModel,
        mask: Mask | None = None,  # [H, W] True where the scene is seen
    ) -> Encoding:
        """The other prior's."""
        return self._prior.encode(image, camera, mask)

    def decode(
        self,
        a: Encoding,
        b: Encoding,
        predicted: Float | None = None,  # [H, W, 2] px, expected matches of a in b
        alone: bool = False,
    ) -> PairGeometry:
        """The other prior's, with C 1 where a match is valid."""
        pair: Any = UnweightedPair(self._prior.decode(a, b, predicted, alone))
        found: PairGeometry = pair
        return found

    def pack(self, encoding: Encoding) -> dict[str, npt.NDArray[Any]]:
        """The other prior's."""
        return self._prior.pack(encoding)

    def unpack(
        self,
        arrays: Mapping[str, npt.NDArray[Any]],  # as from pack
        camera: CameraModel,
    ) -> Encoding:
        """The other prior's."""
        return self._prior.unpack(arrays, camera)

    def warm_up(self) -> None:
        """The other prior's."""
        self._prior.warm_up()
