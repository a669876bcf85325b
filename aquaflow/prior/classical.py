"""The prior without a network: SIFT-homography-initialised DIS flow.

It is the safety net, and the baseline that every trained prior has to beat.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior import flow as dense
from aquaflow.prior.contract import Encoding, Float, Mask
from aquaflow.prior.flow import FlowMatcher, ImageFlow
from aquaflow.prior.flow_pair import (
    FlowEncoding,
    FlowPair,
    best_flow,
    from_homography,
    from_prediction,
)

# --------------------------------------------------------------------------------------------------
# What priors have in common whose matches are dense flow's.

WARM_UP = (240, 320, 3)
"""Shape of a picture to warm up with."""


class _OwnMatcher(threading.local):
    """Each thread's own matcher: OpenCV's flow keeps pictures of a call."""

    def __init__(self) -> None:
        self.own = FlowMatcher()


class FlowPrior:
    """Flow from the likeliest start; without ranges, unless a prior says otherwise."""

    matching: str = "flow from SIFT"
    ranged: bool = False
    metric: bool = False
    unit_sigma: float = float("inf")

    def __init__(self) -> None:
        self._matchers = _OwnMatcher()

    def pack(self, encoding: Encoding) -> dict[str, npt.NDArray[Any]]:
        """The arrays of the encoding; keypoints and features only if they were computed."""
        assert isinstance(encoding, FlowEncoding)
        return encoding.pack()

    def _flow(
        self,
        a: FlowEncoding,
        b: FlowEncoding,
        predicted: Float | None,  # [H, W, 2] px, expected matches of a in b
        alone: bool,
        starts: Iterable[Float | None],  # [H, W, 2] px each; None: from nothing
    ) -> ImageFlow:
        """From one of ``starts``; from nothing but a prediction that stands ``alone``."""
        if alone and predicted is not None:
            starts = from_prediction(predicted)
        near = next(from_prediction(predicted), None)
        return best_flow(self._matchers.own, a, b, starts, near)


# --------------------------------------------------------------------------------------------------
# The classical prior.


class ClassicalPrior(FlowPrior):
    """SIFT-homography-initialised DIS flow behind the prior contract."""

    name = "classical"

    def encode(
        self,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
        camera: CameraModel,
        mask: Mask | None = None,  # [H, W] True where the scene is seen
    ) -> FlowEncoding:
        """Grey picture and texture, for dense flow."""
        grey = dense.normalised_grey(image, mask)
        return FlowEncoding(camera, grey, dense.texture(grey, mask), mask=mask)

    def unpack(
        self,
        arrays: Mapping[str, npt.NDArray[Any]],  # as from pack
        camera: CameraModel,
    ) -> FlowEncoding:
        """The encoding with all that was computed of it."""
        encoding = FlowEncoding(camera, arrays["grey"], arrays["texture"])
        encoding.restore(arrays)
        return encoding

    def warm_up(self) -> None:
        """Nothing is prepared here."""

    def decode(
        self,
        a: Encoding,
        b: Encoding,
        predicted: Float | None = None,  # [H, W, 2] px, expected matches of a in b
        alone: bool = False,
    ) -> FlowPair:
        """Flow from the prediction; where it fails, unless it stands ``alone``, from a SIFT
        homography, then from nothing."""
        assert isinstance(a, FlowEncoding)
        assert isinstance(b, FlowEncoding)
        starts = classical_starts(a, b, predicted)
        return FlowPair(a, b, self._flow(a, b, predicted, alone, starts))


def classical_starts(
    a: FlowEncoding,
    b: FlowEncoding,
    predicted: Float | None,  # [H, W, 2] px, expected matches of a in b
) -> Iterator[Float | None]:
    """[H, W, 2] px flows to start from, the likeliest first, without any network."""
    yield from from_prediction(predicted)
    if predicted is None:
        yield None
    yield from from_homography(a, b)
    if predicted is not None:
        yield None
