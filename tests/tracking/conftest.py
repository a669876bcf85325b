"""Keypoints of a file's pictures are detected once, however many of its tests track them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from aquaflow.prior import homography
from aquaflow.prior.contract import Keypoints


@pytest.fixture(scope="module", autouse=True)
def detected_once() -> Iterator[None]:
    """Half of what tracking a small picture costs; by its pixels, so that nothing else changes."""
    detect, known = homography.detect, dict[tuple[bytes, bytes], Keypoints]()

    def remembered(grey: np.ndarray, mask: np.ndarray | None = None) -> Keypoints:
        key = grey.tobytes(), b"" if mask is None else mask.tobytes()
        if key not in known:
            known[key] = detect(grey, mask)
            known[key].pixels.flags.writeable = known[key].descriptors.flags.writeable = False
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(homography, "detect", remembered)
        yield
