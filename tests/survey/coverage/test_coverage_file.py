"""coverage.npz comes back as it was, and what is no coverage is refused in a sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.survey.coverage.classes import CoverageClass
from aquaflow.survey.coverage.coverage_file import read_coverage_file, write_coverage_file
from tests.survey.coverage.surveys import lawnmower, survey_of


def test_a_view_comes_back_as_it_was(tmp_path: Path) -> None:
    view = survey_of(lawnmower(3, 6.0, 1.0, 0.45))
    write_coverage_file(tmp_path / "coverage.npz", {0: view, 2: view})
    found = read_coverage_file(tmp_path / "coverage.npz")
    assert sorted(found) == [0, 2]
    again = found[0]
    for name in ("classes", "views", "nearest", "directions"):
        assert np.array_equal(getattr(again.plan, name), getattr(view.plan, name))
    assert (again.unit, again.up, again.state.overlap) == (view.unit, view.up, view.state.overlap)
    assert again.area(CoverageClass.WELL) == view.area(CoverageClass.WELL)
    places = view.path + np.array([0.3, 0.4])
    assert np.array_equal(again.classes_at(places), view.classes_at(places))
    assert again.state.suggestion is not None
    assert view.state.suggestion is not None
    assert np.allclose(again.state.suggestion.start, view.state.suggestion.start)
    assert len(again.state.lines) == 3


@pytest.mark.parametrize("content", [None, b"", b"PK\x03\x04 no zip", "other"])
def test_what_is_no_coverage_is_refused_in_a_sentence(
    tmp_path: Path, content: bytes | str | None
) -> None:
    path = tmp_path / "coverage.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        np.savez(path, other=np.zeros(3))
    with pytest.raises(InputError, match="coverage"):
        read_coverage_file(path)
