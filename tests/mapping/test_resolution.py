"""Gaussians as far apart on the ground as is asked for, once the map's scale is known in metres."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from scipy.spatial import KDTree

from aquaflow.config import MappingConfig
from aquaflow.dive.run import resolution_notes
from aquaflow.mapping import state
from aquaflow.mapping.mapper import Mapper
from tests.mapping.mapping_scenes import (
    CAMERA,
    FLOOR_M,
    flat_pointmap,
    floor,
    path,
    picture,
    renderer,
    view_of,
)

Array = npt.NDArray[np.floating]

FOOTPRINT_MM = 1000.0 * FLOOR_M / CAMERA.fx
"""36: of a pixel, a metre being a unit of the map."""


def mapper_of(resolution_mm: float | None, **insertion: Any) -> Mapper:
    """Every pixel may get a Gaussian."""
    every = {"density": 1.0, "bare_probability": 1.0, **insertion}
    stages = {"insertion": every, "medium": {"enabled": False}, "resolution_mm": resolution_mm}
    return Mapper(MappingConfig.model_validate(stages), renderer(), 0)


def insert_along(mapper: Mapper, views: int) -> None:
    for i, T in enumerate(path(views)):
        mapper.insert(view_of(picture(floor(), T), T, i), flat_pointmap(FLOOR_M - T.t[2]))


def spacing_mm(mapper: Mapper) -> Array:
    """[N] to the nearest other one, over the floor."""
    points = mapper.gaussians.means.numpy()[:, :2]
    return 1000.0 * KDTree(points).query(points, k=2)[0][:, 1]


@pytest.mark.parametrize("resolution_mm", [100.0, 200.0, 400.0])
def test_gaussians_are_as_far_apart_as_is_asked_for(resolution_mm: float) -> None:
    mapper = mapper_of(resolution_mm)
    mapper.use_unit(1.0)
    insert_along(mapper, 6)
    spacing = spacing_mm(mapper)
    assert spacing.min() > 0.95 * resolution_mm, "seen aslant, the floor is nearer than it looks"
    assert np.median(spacing) < 1.6 * resolution_mm
    assert mapper.unlimited == 0


def test_four_times_the_gaussians_for_half_the_spacing() -> None:
    counts = []
    for resolution_mm in (100.0, 200.0):
        mapper = mapper_of(resolution_mm)
        mapper.use_unit(1.0)
        insert_along(mapper, 6)
        counts.append(len(mapper.gaussians))
    assert 3.0 < counts[0] / counts[1] < 5.0


def test_metres_of_the_map_are_not_metres_of_the_ground() -> None:
    counts = []
    for unit, resolution_mm in ((1.0, 100.0), (2.5, 250.0)):
        mapper = mapper_of(resolution_mm)
        mapper.use_unit(unit)
        insert_along(mapper, 2)
        counts.append(len(mapper.gaussians))
    assert counts[0] == counts[1]


def test_finer_than_a_pixel_is_as_without() -> None:
    counts = []
    for resolution_mm in (None, 0.5 * FOOTPRINT_MM):
        mapper = mapper_of(resolution_mm)
        mapper.use_unit(1.0)
        insert_along(mapper, 1)
        counts.append(len(mapper.gaussians))
    assert counts[0] == counts[1] == CAMERA.width * CAMERA.height


def test_what_lies_behind_or_before_the_ground_takes_no_room_on_it() -> None:
    mapper = mapper_of(200.0)
    mapper.use_unit(1.0)
    T = path(1)[0]
    for depth in (FLOOR_M, 2.0 * FLOOR_M):
        assert mapper.insert(view_of(picture(floor(), T), T), flat_pointmap(depth)) > 20


def test_a_gaussian_is_as_wide_as_the_spacing() -> None:
    mapper = mapper_of(400.0)
    mapper.use_unit(1.0)
    insert_along(mapper, 1)
    assert 0.2 < float(mapper.gaussians.scales.min()) < 0.3


def test_before_the_scale_is_known_nothing_is_limited_and_what_was_not_is_counted() -> None:
    free, asked = mapper_of(None), mapper_of(200.0)
    for mapper in (free, asked):
        insert_along(mapper, 2)
    assert torch.equal(free.gaussians.means, asked.gaussians.means)
    assert (free.unlimited, asked.unlimited) == (0, len(asked.gaussians))
    again = state.deserialise(*state.serialise(asked), renderer())
    assert again.unlimited == asked.unlimited
    asked.use_unit(1.0)
    before = len(asked.gaussians)
    insert_along(asked, 2)
    assert len(asked.gaussians) == before, "there is ground that is covered already"


@pytest.mark.parametrize(
    ("resolution_mm", "unlimited", "unit", "said"),
    [
        (None, 0, None, None),
        (10.0, 0, 1.0, None),
        (10.0, 1234, None, "never became known in metres"),
        (10.0, 1234, 0.7, "10 mm, does not hold for the 1,234 Gaussians that were added before"),
    ],
)
def test_a_note_says_what_was_not_limited(
    resolution_mm: float | None, unlimited: int, unit: float | None, said: str | None
) -> None:
    mappers: Any = {0: SimpleNamespace(unlimited=unlimited, metres_per_unit=unit)}
    notes = resolution_notes(resolution_mm, mappers)
    assert len(notes) == (said is not None)
    assert said is None or said in notes[0]
