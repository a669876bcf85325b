"""The pictures decode, and show at each place the colour of its class."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from aquaflow.survey.coverage.classes import COLOURS, CoverageClass
from aquaflow.survey.coverage.picture import (  # fmt: skip
    HEIGHT,
    NEXT,
    WIDTH,
    _fit,
    cells_affine,
    cells_png,
    coverage_png,
    in_words,
)
from tests.survey.coverage.surveys import lawnmower, survey_of

VIEW = survey_of(lawnmower(3, 6.0, 1.0, 0.45))


def decoded(png: bytes) -> np.ndarray:
    return np.array(Image.open(io.BytesIO(png)).convert("RGBA"))


def test_the_finished_picture_has_every_classs_colour_and_the_next_line() -> None:
    pixels = decoded(coverage_png(VIEW, "too fast"))
    assert pixels.shape == (HEIGHT, WIDTH, 4)
    for colour in (*COLOURS.values(), NEXT):
        assert (pixels[..., :3] == colour).all(axis=2).sum() > 20


def test_each_pixel_of_the_plan_has_the_class_of_its_place() -> None:
    pixels, fit = decoded(coverage_png(VIEW)), _fit(VIEW)
    corner, off = VIEW.path[0] + [0.4, 0.2], VIEW.path[0] - [4.0, 0.0]
    for place in (corner, off):
        x, y = fit.px(place).astype(int)
        seen = CoverageClass(int(VIEW.classes_at(place)))
        if 0 <= x < WIDTH:
            assert tuple(pixels[y, x, :3]) == COLOURS.get(seen, (250, 251, 251))


def test_the_cells_lie_on_the_page_where_they_were_seen() -> None:
    pixels, affine = decoded(cells_png(VIEW)), cells_affine(VIEW)
    rows, columns = pixels.shape[:2]
    u, v = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    places = np.dstack([u, v, np.ones_like(u)]) @ affine.T
    classes = VIEW.classes_at(places)
    assert (classes == VIEW.plan.classes[::-1]).all()
    assert ((pixels[..., 3] == 0) == (classes == CoverageClass.NOT)).all()
    for seen, colour in COLOURS.items():
        assert (pixels[classes == seen][:, :3] == colour).all()


@pytest.mark.parametrize(("spacing", "said"), [(0.96, "overlap 60 %"), (3.6, "gap of 1.2 m")])
def test_the_overlap_is_said_in_words(spacing: float, said: str) -> None:
    assert said in in_words(survey_of(lawnmower(2, 8.0, spacing, 0.45)))
