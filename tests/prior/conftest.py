"""What several tests of priors ask for."""

from __future__ import annotations

import pytest

from aquaflow.prior import homography


@pytest.fixture
def no_sift(monkeypatch: pytest.MonkeyPatch) -> None:
    """SIFT must not run: the network's matches are good."""

    def refuse(*_: object) -> None:
        raise AssertionError("SIFT ran though the network's matches were good")

    monkeypatch.setattr(homography, "detect", refuse)
