"""Limits the number of views: a long dive keeps only some of the views of each place."""

from __future__ import annotations

from collections.abc import Sequence

from aquaflow.render.views import View, in_time


def same_group(view: View, views: Sequence[View]) -> list[View]:
    """Those of ``views`` with the same keyframe and the same robustness as ``view``."""
    return [v for v in views if v.keyframe == view.keyframe and v.robust == view.robust]


def drop_surplus(
    views: list[View],
    group: Sequence[View],  # those of ``views`` that have a budget together
    most: int,
) -> None:
    """Drop views, and their pixels, until the ``group`` has at most ``most``.

    Always the one whose neighbours are nearest to each other in time, the earliest of equals, so
    that those that stay are spread over the whole time. First and last stay.
    """
    kept = in_time(group)
    while len(kept) > max(most, 2):
        index = [view.frame_index for view in kept]
        gaps = [after - before for before, after in zip(index, index[2:])]  # noqa: B905
        dropped = kept.pop(1 + gaps.index(min(gaps)))
        views.remove(dropped)
        dropped.delete_pixels()
