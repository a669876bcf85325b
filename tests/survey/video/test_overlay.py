"""Words below and in pictures."""

from __future__ import annotations

from datetime import datetime, timezone

import numpy as np
import pytest

from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.survey.video.overlay import GROUND, INK, MARK, band, mark, words_of

ROW = PoseRow(
    7, 83.456, datetime(2026, 11, 22, 13, 3, 5, tzinfo=timezone.utc), 0, 0.0, 0.0, 0.0, "m",
    depth_m=12.345, heading_deg=271.4, speed_m_s=0.317,
)  # fmt: skip


def test_only_what_the_dive_knows_is_said_with_its_unit() -> None:
    assert words_of(83.456, ROW, "true north") == [
        "2026-11-22 13:03:05 UTC", "depth 12.35 m", "heading 271° (true north)", "speed 0.32 m/s",
    ]  # fmt: skip
    bare = PoseRow(7, 83.456, None, 0, 0.0, 0.0, 0.0, "map units")
    assert words_of(83.456, bare, "first keyframe") == ["t 1:23.46"]
    assert words_of(59.999, None, "first keyframe") == ["t 1:00.00"]


@pytest.mark.parametrize("width", [320, 1920])
def test_a_band_is_as_wide_as_the_picture_and_its_words_do_not_touch(width: int) -> None:
    words = words_of(83.456, ROW, "true north")
    drawn = band(width, ["camera", "without water"], words)
    assert drawn.shape[1] == width
    is_ink = (drawn != GROUND).any(axis=2)
    above, below = is_ink[: drawn.shape[0] // 2], is_ink[drawn.shape[0] // 2 :]
    assert above[:, width // 2 : width // 2 + width // 8].any()
    empty = ~below.any(axis=0)
    edges = np.flatnonzero(np.diff(empty.astype(int)))
    gaps = np.sort(np.diff(edges)[1::2])  # between two stretches of ink
    between = len(words) - 1
    assert gaps[-between] > 1.3 * gaps[-between - 1]  # the next are those within the words
    assert empty[-1]
    assert empty[0]
    assert np.abs(drawn.astype(int) - INK).sum(axis=2).min() < 60


def test_a_mark_covers_a_corner_only() -> None:
    picture = np.full((90, 160, 3), 120, np.uint8)
    found = mark(picture, "no pose")
    changed = (found != picture).any(axis=2)
    assert changed[:5, :5].all()
    assert changed.mean() < 0.15
    assert np.abs(found.astype(int) - MARK).sum(axis=2).min() < 60
    assert (picture == 120).all()
