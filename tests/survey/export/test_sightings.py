"""Which views see a point, and how well they say where it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch

from aquaflow.base.errors import InputError
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.survey.export.ortho.drawing import Colours
from aquaflow.survey.export.ortho.ground import Ground, ground_of
from aquaflow.survey.export.ortho.sightings import ViewRanges
from aquaflow.water.white_balance import WhiteBalance
from tests.mapping.mapping_scenes import gaussians_at
from tests.metric_scenes import metric_frame
from tests.survey.export.survey_scenes import ALTITUDE_M, CAMERA, DEPTH_M, STOPS, height, surveyed

Array = npt.NDArray[np.float64]


@pytest.fixture
def mapper() -> Mapper:
    return surveyed(metric_frame(T_nm=Sim3.identity()))


def ground(mapper: Mapper) -> Ground:
    frame = metric_frame(T_nm=Sim3.identity(), origin=None, north="initial heading")
    return ground_of(frame, mapper)


def ground_point(north: float, east: float, above: float = 0.0) -> Array:
    """[1, 3] on the ground axes: east, north, up."""
    z = height(np.array(north), np.array(east)) - DEPTH_M + above
    return np.array([[east, north, float(z)]])


def test_the_views_that_see_a_point_are_counted(mapper: Mapper, tmp_path: Path) -> None:
    ranges = ViewRanges(mapper, ground(mapper), tmp_path)
    north, east = 1.9, 1.7
    point = ground_point(north, east)
    reach = (DEPTH_M - ALTITUDE_M + point[0, 2]) * -0.5 / CAMERA.fx
    around = [
        abs(x - north) < reach * CAMERA.height and abs(y - east) < reach * CAMERA.width
        for x in STOPS
        for y in STOPS
    ]
    assert ranges.see(point).count.tolist() == [sum(around)]
    assert sum(around) > 3


def test_what_lies_behind_the_ground_or_in_the_water_is_not_seen(
    mapper: Mapper, tmp_path: Path
) -> None:
    ranges = ViewRanges(mapper, ground(mapper), tmp_path)
    points = [ground_point(1.9, 1.7, above) for above in (-0.4, 0.4)]
    seen = ranges.see(np.vstack(points))
    assert seen.count.tolist() == [0, 0]
    assert np.isnan(seen.sigma).all()
    assert np.isinf(seen.nearest).all()


def test_what_stands_between_hides_the_ground(mapper: Mapper, tmp_path: Path) -> None:
    point = ground_point(1.9, 1.7)
    before = ViewRanges(mapper, ground(mapper), tmp_path).see(point)
    view = next(v for v in mapper.views if v.T_wc.t[0] == STOPS[1] and v.T_wc.t[1] == STOPS[1])
    halfway = 0.5 * (view.T_wc.t + point[0, [1, 0, 2]] * [1.0, 1.0, -1.0])
    plate = gaussians_at(torch.from_numpy(halfway[None]), torch.full((1, 3), 0.5), 0.02, 0.99)
    mapper.scene.gaussians.append(plate)
    after = ViewRanges(mapper, ground(mapper), tmp_path).see(point)
    assert before.count[0] - after.count[0] == 1


def test_a_place_that_was_filmed_and_not_mapped_is_held(mapper: Mapper, tmp_path: Path) -> None:
    ranges = ViewRanges(mapper, ground(mapper), tmp_path)
    mapped, beyond = ground_point(1.9, 1.7), ground_point(1.9, -0.3)
    assert ranges.hold(mapped).tolist() == ranges.see(mapped).count.tolist()
    assert ranges.see(beyond).count.tolist() == [0]
    rows = sum(abs(x - 1.9) < 0.5 * CAMERA.height / CAMERA.fx * ALTITUDE_M for x in STOPS)
    assert ranges.hold(beyond).tolist() == [rows]  # by the views of the westernmost stop
    outside, behind = ground_point(1.9, -2.5), ground_point(1.9, 1.7, above=-0.4)
    assert ranges.hold(outside).tolist() == [0]
    assert ranges.hold(behind).tolist() == [0]


def test_pictures_that_end_earlier_hold_less(mapper: Mapper, tmp_path: Path) -> None:
    ranges = ViewRanges(mapper, ground(mapper), tmp_path)
    steps = np.linspace(0.2, 3.4, 40)
    east, north = (each.ravel() for each in np.meshgrid(steps, steps))
    points = np.column_stack([east, north, height(north, east) - DEPTH_M])
    narrow, plain, wide = (int(ranges.hold(points, px).sum()) for px in (4.0, 0.0, -4.0))
    assert narrow < plain < wide


def test_the_height_is_known_as_well_as_the_rays_cross(mapper: Mapper, tmp_path: Path) -> None:
    """Two views h above a point and b apart leave its height open by r / (f sqrt(2) sin a)."""
    mapper.views = [mapper.views[5], mapper.views[9]]
    north, east = (mapper.views[0].T_wc.t + mapper.views[1].T_wc.t)[:2] / 2.0
    point = ground_point(float(north), float(east))
    seen = ViewRanges(mapper, ground(mapper), tmp_path).see(point)
    half = 0.5 * (STOPS[2] - STOPS[1])
    above = -(DEPTH_M - ALTITUDE_M) - point[0, 2]
    r = np.hypot(half, above)
    assert seen.count.tolist() == [2]
    assert seen.nearest[0] == pytest.approx(r)
    assert seen.sigma[0] == pytest.approx(r / CAMERA.fx / (np.sqrt(2.0) * half / r), rel=1e-6)


def test_the_raster_spans_what_the_views_show(mapper: Mapper, tmp_path: Path) -> None:
    ranges = ViewRanges(mapper, ground(mapper), tmp_path)
    assert ranges.footprint == pytest.approx(ALTITUDE_M / CAMERA.fx, rel=0.1)
    assert ranges.median_range == pytest.approx(ALTITUDE_M, rel=0.1)
    assert (ranges.low < 0.1).all()
    assert (ranges.high > 3.7).all()


def test_views_that_show_nothing_are_refused(mapper: Mapper, tmp_path: Path) -> None:
    for view in mapper.views:
        view.T_wc = Sim3(view.T_wc.R, view.T_wc.t + np.array([0.0, 0.0, 500.0]))
    with pytest.raises(InputError, match="show nothing of its map"):
        ViewRanges(mapper, ground(mapper), tmp_path)


def test_no_channel_is_amplified_beyond_what_its_light_allows(mapper: Mapper) -> None:
    mapper.medium.set_water(
        *(torch.tensor(v) for v in ((2.0, 0.3, 0.2), (0.1, 0.2, 0.3), (0.5,) * 3))
    )
    mapper.scene.balance = WhiteBalance(1.0, (0.4, 0.4, 0.4), (1.0, 1.0, 1.0), 0.1)
    water = mapper.scene.water(mapper.views[0])
    assert water is not None
    colours, far = Colours(mapper, 1.0, None), np.full((1, 1), 3.0)
    dark, bright = (torch.full((1, 1, 3), level) for level in (0.3, 0.5))
    with torch.no_grad():
        T = water.transmission(torch.full((1, 1), 3.0)).numpy()
        recovered = mapper.scene.balance.recover(bright * 0.0, torch.full((1, 1), 3.0), water)
    (a, share), (b, _) = colours.of(dark, far), colours.of(bright, far)
    assert recovered.allowed is not None
    red = (b.astype(float) - a)[0, 0, 0] / 255.0 / (0.2 * T[0, 0, 0])
    assert red < 1.0 / T[0, 0, 0]  # wholly restored it would be
    assert 0.3 < share[0, 0] < 0.9


def test_without_water_colours_are_the_maps(mapper: Mapper) -> None:
    shown, share = Colours(mapper, 1.0, None).of(torch.full((1, 1, 3), 0.4), np.full((1, 1), 2.0))
    assert shown.tolist() == [[[102, 102, 102]]]
    assert share.tolist() == [[1.0]]
