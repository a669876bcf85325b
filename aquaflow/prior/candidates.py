"""Several flows to start from, one after the other, until one explains the pair.

DIS follows displacements up to some 15 % of the picture's width; what is larger must be known
before it starts. Every start costs as much as the flow itself, so the likely ones come first.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from aquaflow.prior import homography as sparse
from aquaflow.prior.fields import pixel_grid
from aquaflow.prior.flow import Float, FlowMatcher, ImageFlow
from aquaflow.prior.flow_pair import FlowEncoding

GOOD_SHARE = 0.5
"""A flow that matches this part of the picture needs no rival."""


def best_flow(
    matcher: FlowMatcher,
    a: FlowEncoding,
    b: FlowEncoding,
    starts: Iterable[Float | None],  # [H, W, 2] px each, a to b; None: from nothing
    near: Float | None = None,  # [H, W, 2] px, a to b
) -> ImageFlow:
    """The flow of the first start that explains the pair, or the one that matches most.

    From ``near``, where it is known well, a quicker flow comes first. ``starts`` is asked for the
    next one only when those before were not good enough.
    """
    if near is not None:
        flow = matcher(a.grey, b.grey, a.texture, b.texture, near, quick=True)
        if flow.share >= GOOD_SHARE:
            return flow
    best: ImageFlow | None = None
    for start in starts:
        flow = matcher(a.grey, b.grey, a.texture, b.texture, start)
        if best is None or flow.share > best.share:
            best = flow
        if best.share >= GOOD_SHARE:
            break
    assert best is not None
    return best


def from_prediction(
    predicted: Float | None,  # [H, W, 2] px, expected matches
) -> Iterator[Float]:
    """The expected displacement, if something is expected."""
    if predicted is not None:
        height, width = predicted.shape[:2]
        yield predicted - pixel_grid(height, width)


def from_homography(a: FlowEncoding, b: FlowEncoding) -> Iterator[Float]:
    """The homography that most SIFT matches follow, if there is one."""
    H = sparse.homography(a.keypoints, b.keypoints)
    if H is not None:
        height, width = a.grey.shape
        yield sparse.flow_of_homography(H, height, width)
