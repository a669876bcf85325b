"""What priors have in common whose matches are dense flow's."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from typing import Any

import numpy.typing as npt

from aquaflow.prior.candidates import best_flow, from_prediction
from aquaflow.prior.contract import Encoding, Float
from aquaflow.prior.flow import FlowMatcher, ImageFlow
from aquaflow.prior.flow_pair import FlowEncoding

WARM_UP = (240, 320, 3)
"""Shape of a picture to warm up with."""


class _OwnMatcher(threading.local):
    """Each thread's own matcher: OpenCV's flow keeps pictures of a call."""

    def __init__(self) -> None:
        self.own = FlowMatcher()


class FlowPrior:
    """Flow from the likeliest start; without ranges, unless a prior says otherwise."""

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
