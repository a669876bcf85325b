"""The learned prior that tracks: descriptors give coarse matches, flow refines them.

A network distinguishes the cells of a picture, whatever the water, the light and the
distance did to it; but cells are coarse. Dense flow is exact to a fifth of a pixel, but only finds
what is near its start. So flow starts at the descriptors' matches
(notes/measurements.md#compact-prior).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior import flow as dense
from aquaflow.prior.candidates import from_homography, from_prediction
from aquaflow.prior.classical import classical_starts
from aquaflow.prior.coarse import coarse_flow
from aquaflow.prior.contract import Encoding, Float, Mask, RangeUnit
from aquaflow.prior.flow_pair import FlowEncoding, FlowPair
from aquaflow.prior.flow_prior import WARM_UP, FlowPrior
from aquaflow.prior.learned_range import spread_over
from aquaflow.prior.network import ComparedPair, Describer, Half, Picture


@dataclass
class HybridEncoding(FlowEncoding):
    """A picture made ready for flow; the network looks at it when first needed."""

    picture: Picture
    describer: Describer

    @cached_property
    def features(self) -> Half:
        """What the network says of the picture alone."""
        return self.describer.features(self.picture)

    def pack(self) -> dict[str, npt.NDArray[Any]]:
        """Its arrays, not copied; keypoints and features only if they were computed."""
        arrays = super().pack() | {"picture": self.picture}
        features = vars(self).get("features")
        return arrays if features is None else arrays | {"features": features}

    def restore(
        self,
        arrays: Mapping[str, npt.NDArray[Any]],  # as from pack
    ) -> None:
        """Take back what was computed when first asked for, and packed."""
        super().restore(arrays)
        if "features" in arrays:
            self.features = arrays["features"]


class LazyComparison:
    """The network's view of a pair of encodings, asked for at most once."""

    def __init__(self, a: HybridEncoding, b: HybridEncoding) -> None:
        self._a, self._b = a, b

    @cached_property
    def found(self) -> ComparedPair:
        """What the network says of the pair."""
        a, b = self._a, self._b
        return a.describer.compare(a.features, b.features, a.camera, b.camera)

    @property
    def asked(self) -> bool:
        """True if the network has looked at the pair."""
        return "found" in vars(self)


class HybridPair(FlowPair):
    """Matches of flow; ranges and their confidence are the network's, that of matches is both's."""

    def __init__(
        self,
        a: HybridEncoding,
        b: HybridEncoding,
        flow: dense.ImageFlow,
        comparison: LazyComparison,
    ) -> None:
        super().__init__(a, b, flow)
        self._describer, self._comparison = a.describer, comparison
        self._asked = comparison.asked

    @cached_property
    def C(self) -> Float:
        """The flow's, times the network's where the matches come from it: flow that only confirms
        a prediction needs no second opinion, and asking for one costs more than the flow."""
        certain = dense.confidence(self.flow)
        cells = self._comparison.found.confidence if self._asked else None
        return certain if cells is None else certain * spread_over(cells, *certain.shape)

    @cached_property
    def _in_a(self) -> tuple[Float, Float]:
        """(X_a, Q_a)"""
        return self._comparison.found.range_a.pointmap(self._a.camera)

    @cached_property
    def _in_b(self) -> tuple[Float, Float]:
        """(X_b, Q_b)"""
        return self._comparison.found.range_b.pointmap(self._b.camera)

    @property
    def range_unit(self) -> RangeUnit:
        return self._describer.range_unit

    @property
    def X_a(self) -> Float | None:
        return self._in_a[0]

    @property
    def X_b(self) -> Float | None:
        return self._in_b[0]

    @property
    def Q_a(self) -> Float | None:
        return self._in_a[1]

    @property
    def Q_b(self) -> Float | None:
        return self._in_b[1]


class HybridPrior(FlowPrior):
    """Flow that starts from learned matches, behind the prior contract."""

    ranged = True

    def __init__(self, describer: Describer, learned_matches: bool = True) -> None:
        """Without ``learned_matches`` flow starts at keypoints where a prediction fails."""
        super().__init__()
        self.name, self.metric = describer.name, describer.metric
        self.unit_sigma = describer.unit_sigma
        self._learned_matches = learned_matches
        self._describer = describer

    def encode(
        self,
        image: Picture,  # [H, W, 3] RGB
        camera: CameraModel,
        mask: Mask | None = None,  # [H, W] True where the scene is seen
    ) -> HybridEncoding:
        """What dense flow and the network's comparison need of a picture."""
        grey = dense.normalised_grey(image, mask)
        fitted, texture = self._describer.fit(image), dense.texture(grey, mask)
        return HybridEncoding(camera, grey, texture, fitted, self._describer, mask=mask)

    def unpack(
        self,
        arrays: Mapping[str, npt.NDArray[Any]],  # as from pack
        camera: CameraModel,
    ) -> HybridEncoding:
        """The encoding with all that was computed of it."""
        encoding = HybridEncoding(
            camera, arrays["grey"], arrays["texture"], arrays["picture"], self._describer
        )
        encoding.restore(arrays)
        return encoding

    def decode(
        self,
        a: Encoding,
        b: Encoding,
        predicted: Float | None = None,  # [H, W, 2] px, expected matches of a in b
        alone: bool = False,
    ) -> HybridPair:
        """Flow from the prediction; where it fails, unless it stands ``alone``, from the
        descriptors, if the network has any, then from keypoints."""
        assert isinstance(a, HybridEncoding)
        assert isinstance(b, HybridEncoding)
        comparison = LazyComparison(a, b)
        starts = _starts(a, b, predicted, comparison if self._learned_matches else None)
        return HybridPair(a, b, self._flow(a, b, predicted, alone, starts), comparison)

    def warm_up(self) -> None:
        """Run the network once: the first picture of a dive then waits for no preparation."""
        features = self._describer.features(self._describer.fit(np.zeros(WARM_UP, np.uint8)))
        height, width, _ = WARM_UP
        camera = CameraModel(width, height, width, width, 0.5 * width, 0.5 * height)
        learned_range = self._describer.compare(features, features, camera, camera).range_a
        learned_range.pointmap(camera)


def _starts(
    a: HybridEncoding,
    b: HybridEncoding,
    predicted: Float | None,  # [H, W, 2] px, expected matches of a in b
    comparison: LazyComparison | None,
) -> Iterator[Float | None]:
    if not a.describer.describes:
        yield from classical_starts(a, b, predicted)
        return
    yield from from_prediction(predicted)
    cells = None if comparison is None else comparison.found.cells
    flow = None if cells is None else coarse_flow(*cells, *a.grey.shape)
    if flow is not None:
        yield flow
    yield from from_homography(a, b)
    yield None
