"""Several flows to start from, one after the other, until one explains the pair.

DIS follows displacements up to some 15 % of the picture's width; what is larger must be known
before it starts. Every start costs as much as the flow itself, so the likely ones come first.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from aquaflow.prior import homography as sparse
from aquaflow.prior.fields import pixel_grid
from aquaflow.prior.flow import Float, Flow, FlowMatcher
from aquaflow.prior.flow_pair import FlowEncoding

GOOD_SHARE = 0.5
"""A flow that matches this part of what stays in view needs no rival."""
LEAST_IN_VIEW = 0.5
"""Part of the picture that counts as staying in view at least: a prediction of a wider turn may be
wrong itself, and the matches of a quarter of the picture are what it must bring then."""
COARSE_PX = 8
"""Spacing of the pixels by which what stays in view is measured, to a percent."""


def best_flow(
    matcher: FlowMatcher,
    a: FlowEncoding,
    b: FlowEncoding,
    starts: Iterable[Float | None],  # [H, W, 2] px each, a to b; None: from nothing
    near: Float | None = None,  # [H, W, 2] px, a to b
) -> Flow:
    """The flow of the first start that explains the pair, or the one that matches most.

    From ``near``, where it is known well, a quicker flow comes first; what it takes out of view
    cannot be matched, and counts for no flow. ``starts`` is asked for the next one only when those
    before were not good enough.
    """
    enough = GOOD_SHARE
    if near is not None:
        enough *= max(share_in_view(near), LEAST_IN_VIEW)
        flow = matcher(a.grey, b.grey, a.texture, b.texture, near, quick=True)
        if flow.share >= enough:
            return flow
    best: Flow | None = None
    for start in starts:
        flow = matcher(a.grey, b.grey, a.texture, b.texture, start)
        if best is None or flow.share > best.share:
            best = flow
        if best.share >= enough:
            break
    assert best is not None
    return best


def share_in_view(
    displacement: Float,  # [H, W, 2] px, a to b
) -> float:
    """Part of the pixels whose match lies in the other picture too."""
    height, width = displacement.shape[:2]
    coarse = (slice(None, None, COARSE_PX), slice(None, None, COARSE_PX))
    target = displacement[coarse] + pixel_grid(height, width)[coarse]
    inside = ((target > 0.0) & (target < (width, height))).all(axis=-1)
    return float(inside.mean())


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
