"""Matches between keyframes that the graph's thread makes: dense flow from where poses lead."""

from __future__ import annotations

from dataclasses import dataclass

from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.prior.candidates import best_flow, from_prediction
from aquaflow.prior.contract import Encoding
from aquaflow.prior.flow import FlowMatcher
from aquaflow.prior.flow_pair import FlowEncoding, FlowPair
from aquaflow.tracking.pose.expected_matches import expected_matches


@dataclass(frozen=True)
class KeyframeView:
    """What matching needs of a keyframe; nothing of it changes later."""

    number: int
    encoding: Encoding
    pointmap: Pointmap


class KeyframePairs:
    """Matches pairs of keyframes; for one thread, because OpenCV's flow keeps a state."""

    def __init__(self) -> None:
        self._matcher = FlowMatcher()

    def match(self, a: KeyframeView, b: KeyframeView, T_ba: Sim3) -> FlowPair | None:
        """The pair's matches, looked for where ``T_ba`` leads to and nowhere else; None for
        pictures that were not made ready for flow."""
        first, second = a.encoding, b.encoding
        if not (isinstance(first, FlowEncoding) and isinstance(second, FlowEncoding)):
            return None
        expected = expected_matches(a.pointmap, T_ba, b.pointmap.camera)
        return FlowPair(
            first, second, best_flow(self._matcher, first, second, from_prediction(expected))
        )
