"""The height field of a map that is as an ideal survey of known ground would make it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.dive.shown_views import ShownViews
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.survey.export.ortho.ground import Ground, ground_of
from aquaflow.survey.measure.areas import areas
from aquaflow.survey.measure.drawn_heights import draw_heights, found_cell
from aquaflow.survey.measure.height_field import HeightField
from aquaflow.survey.measure.quantity import Scale
from aquaflow.survey.measure.roughness import chain_ratio, relief, surface_ratio
from tests.metric_scenes import metric_frame
from tests.survey.export.survey_scenes import (
    ALTITUDE_M,
    CAMERA,
    DEPTH_M,
    SIDE_M,
    SPACING_M,
    STOPS,
    height,
    surveyed,
)
from tests.survey.measure.fields import CELL

FRAME = metric_frame(T_nm=Sim3.identity(), origin=None, north="initial heading")
EXACT = Scale("m", 0.0, 0.0)
FINE = 20
"""Samples along a cell of the truth."""


@pytest.fixture(scope="module")
def mapper() -> Mapper:
    return surveyed(FRAME)


@pytest.fixture(scope="module")
def drawn(mapper: Mapper, tmp_path_factory: pytest.TempPathFactory) -> HeightField:
    return draw_heights(ShownViews(mapper), ground(mapper), tmp_path_factory.mktemp("work"), CELL)


def ground(mapper: Mapper) -> Ground:
    return ground_of(FRAME, mapper)


def truth(field: HeightField) -> HeightField:
    """The true means of the same cells where they are mapped, without errors."""
    from dataclasses import replace

    steps = (np.arange(FINE) + 0.5) / FINE * field.cell
    total = np.zeros(field.height.shape)
    for right in steps:
        for down in steps:
            x = field.grid.left + np.arange(field.grid.width) * field.cell + right
            y = field.grid.top - np.arange(field.grid.height) * field.cell - down
            east, north = np.meshgrid(x, y)
            total += height(north, east) - DEPTH_M
    known = np.where(field.mapped, total / FINE**2, np.nan)
    return replace(field, height=known, blurred=known, sigma=0.0 * field.sigma)


def true_area(beyond: float) -> float:
    """Of what two pictures show, up to so far beyond the Gaussians."""
    steps = np.arange(0.005 - beyond, SIDE_M + beyond, 0.01)
    north, east = np.meshgrid(steps, steps)
    above = ALTITUDE_M - height(north, east)
    count = np.zeros(north.shape, int)
    for stop_north in STOPS:
        for stop_east in STOPS:
            inside = np.abs(north - stop_north) * CAMERA.fx < 0.5 * CAMERA.height * above
            count += inside & (np.abs(east - stop_east) * CAMERA.fx < 0.5 * CAMERA.width * above)
    return float((count >= 2).sum()) * 0.01**2


def test_heights_are_those_of_the_ground(drawn: HeightField) -> None:
    error = (drawn.height - truth(drawn).height)[drawn.mapped]
    assert np.sqrt(np.mean(error**2)) < 0.005 * ALTITUDE_M
    assert drawn.resolution >= 0.9 * SPACING_M


def test_rugosity_and_relief_are_within_five_percent_and_in_their_intervals(
    drawn: HeightField,
) -> None:
    exact = truth(drawn)
    for statistic in (surface_ratio, chain_ratio):
        found, true = statistic(drawn), statistic(exact).value
        assert found.value == pytest.approx(true, rel=0.05)
        assert found.low <= true <= found.high
    span, true_span = relief(drawn, 0.0, 0.0, "m"), relief(exact, 0.0, 0.0, "m").value
    assert span.value == pytest.approx(true_span, rel=0.05)
    assert span.low <= true_span <= span.high


def test_the_surveyed_area_is_within_two_percent_and_in_its_interval(drawn: HeightField) -> None:
    found, true = areas(drawn, surface_ratio(drawn), EXACT), true_area(beyond=1.5)
    assert found.surveyed.value == pytest.approx(true, rel=0.02)
    assert found.surveyed.low <= true <= found.surveyed.high
    assert found.mapped.value == pytest.approx(true_area(beyond=0.0) / true, rel=0.02)


def test_what_no_gaussian_stands_for_is_surveyed_and_not_mapped(
    mapper: Mapper, drawn: HeightField, tmp_path: Path
) -> None:
    import torch

    holed = surveyed(FRAME)
    means = holed.gaussians.means.numpy()
    kept = ~((np.abs(means[:, 0] - 1.8) < 0.4) & (np.abs(means[:, 1] - 1.8) < 0.4))
    holed.scene.gaussians.keep(torch.from_numpy(kept))
    found = draw_heights(ShownViews(holed), ground(holed), tmp_path, CELL)
    before, after = (areas(each, surface_ratio(each), EXACT) for each in (drawn, found))
    assert after.surveyed.value == pytest.approx(before.surveyed.value, rel=0.02)
    assert before.mapped.value - after.mapped.value == pytest.approx(
        0.64 / before.surveyed.value, rel=0.2
    )


@pytest.mark.parametrize(
    ("resolution", "cell"), [(0.03, 0.1), (0.016, 0.05), (0.04, 0.2), (0.3, 1.0), (0.2, 1.0)]
)
def test_cells_are_of_few_sizes_and_three_resolutions_long(resolution: float, cell: float) -> None:
    assert found_cell(resolution) == pytest.approx(cell)


def test_too_many_cells_are_refused(mapper: Mapper, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="larger --cell"):
        draw_heights(ShownViews(mapper), ground(mapper), tmp_path, 1e-9)


def test_ground_that_one_view_alone_sees_has_no_heights(mapper: Mapper, tmp_path: Path) -> None:
    alone = surveyed(FRAME)
    alone.views = alone.views[:1]
    with pytest.raises(InputError, match="no two views"):
        draw_heights(ShownViews(alone), ground(alone), tmp_path, CELL)
