"""The one map of a site: which dive's Gaussians stay, where, and in what colours."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.dive.ply import PlyGaussians
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.change.site_map import DayMap, combine
from aquaflow.survey.export.mesh.view_surfaces import ViewSurfaces
from tests.survey.change.sites import HALF, TALL, brightness, height, views_of
from tests.survey.export.mesh_scenes import above_plane, surfaces_of, to_plane

Array = npt.NDArray[np.float64]

SPACING = 0.015
BOX = (0.1, 0.1)
SHARP = CameraModel(480, 360, 400.0, 400.0, 240.0, 180.0)


def gaussians(
    box: tuple[float, float] | None, light: tuple[float, ...] = (1, 1, 1)
) -> PlyGaussians:
    """One on every place of the ground and of the box's upper side."""
    steps = np.arange(-2.0, 2.0, SPACING)
    xy = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    colours = brightness(xy, box)[:, None] * np.array([1.2, 1.0, 0.7]) * light
    return PlyGaussians(
        np.column_stack([xy, height(xy, box)]), np.tile((1.0, 0.0, 0.0, 0.0), (len(xy), 1)),
        np.full((len(xy), 3), SPACING), np.full(len(xy), 0.9), colours,
    )  # fmt: skip


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("views")


@cache
def sharp_views(box: tuple[float, float] | None, work: Path) -> ViewSurfaces:
    """Of cameras whose pixels are 5 mm wide on the ground: the box is higher than dives differ."""
    return views_of(box, work, SHARP)


def from_afar(work: Path, far: float = 6.0) -> ViewSurfaces:
    """The bare ground from ``far`` up, as the five cameras of 2 m show it from there."""
    poses = [Sim3(pose.R, np.array([*pose.t[:2], far])) for pose in above_plane()]
    return surfaces_of(poses, [to_plane] * 5, work, SHARP)


def near(part: PlyGaussians, box: tuple[float, float]) -> npt.NDArray[np.bool_]:
    return (np.abs(part.means[:, :2] - box) < HALF - SPACING).all(axis=1)


def seen(part: PlyGaussians) -> npt.NDArray[np.bool_]:
    """Well within what all cameras show."""
    return (np.abs(part.means[:, :2]) < 0.5).all(axis=1)


@pytest.fixture
def bare(work: Path) -> Callable[[str], DayMap]:
    return lambda name: DayMap(name, gaussians(None), sharp_views(None, work))


def test_of_a_place_that_both_show_the_later_stays_and_elsewhere_each(
    bare: Callable[[str], DayMap],
) -> None:
    monday, tuesday = combine([bare("monday"), bare("tuesday")])
    assert (monday.name, tuesday.name) == ("monday", "tuesday")
    assert len(tuesday.gaussians.means) == len(gaussians(None).means)
    assert not seen(monday.gaussians).any()
    beyond = np.abs(monday.gaussians.means[:, :2]).max(axis=1) > 1.8
    assert beyond.sum() == (np.abs(gaussians(None).means[:, :2]).max(axis=1) > 1.8).sum()
    assert (monday.gone, tuesday.gone, tuesday.replaced) == (0, 0, 0)


def test_what_a_later_dive_sees_past_is_gone(bare: Callable[[str], DayMap], work: Path) -> None:
    monday = DayMap("monday", gaussians(BOX), sharp_views(BOX, work))
    before, after = combine([monday, bare("tuesday")])
    assert before.gone == (gaussians(BOX).means[:, 2] == TALL).sum()
    assert not (before.gaussians.means[:, 2] > 0.5 * TALL).any()
    assert near(after.gaussians, BOX).any()


def test_what_is_new_stays_and_hides_what_was_there(
    bare: Callable[[str], DayMap], work: Path
) -> None:
    tuesday = DayMap("tuesday", gaussians(BOX), sharp_views(BOX, work))
    before, after = combine([bare("monday"), tuesday])
    assert after.gone == after.replaced == 0
    assert (after.gaussians.means[near(after.gaussians, BOX), 2] == TALL).all()
    hidden = before.gaussians.means[near(before.gaussians, BOX)]
    assert len(hidden)
    assert (hidden[:, 2] < 0.02).all()


def test_a_look_from_afar_replaces_no_close_one_whichever_is_later(work: Path) -> None:
    close = DayMap("close", gaussians(None), sharp_views(None, work))
    far = DayMap("far", gaussians(None), from_afar(work))
    for days in ([close, far], [far, close]):
        parts = {part.name: part.gaussians for part in combine(days)}
        assert seen(parts["close"]).sum() == seen(close.gaussians).sum()
        assert not seen(parts["far"]).any()


def test_small_pictures_replace_no_sharper_ones_and_as_sharp_ones_do(work: Path) -> None:
    sharp = DayMap("sharp", gaussians(None), sharp_views(None, work))
    small = DayMap("small", gaussians(None), views_of(None, work, SHARP.resize(320, 240)))
    before, after = combine([sharp, small])
    assert seen(before.gaussians).sum() == seen(sharp.gaussians).sum()
    assert not seen(after.gaussians).any()
    higher = DayMap("higher", gaussians(None), from_afar(work, 2.2))
    before, after = combine([sharp, higher])
    assert not seen(before.gaussians).any()
    assert seen(after.gaussians).sum() == seen(higher.gaussians).sum()


def test_a_look_from_afar_sees_what_is_gone(work: Path) -> None:
    mast = gaussians(None)
    at_mast = np.hypot(*mast.means[:, :2].T) < 0.05
    mast.means[at_mast, 2] = 1.5
    close = DayMap("monday", mast, sharp_views(None, work))
    before, _ = combine([close, DayMap("tuesday", gaussians(None), from_afar(work))])
    assert before.gone == at_mast.sum()
    assert not (before.gaussians.means[:, 2] > 1.0).any()


def test_earlier_colours_get_the_light_of_later_ones(work: Path) -> None:
    light = np.array((1.25, 0.8, 0.7))
    monday = DayMap("monday", gaussians(None), sharp_views(None, work))
    tuesday = DayMap("tuesday", gaussians(None, tuple(light)), sharp_views(None, work))
    before, after = combine([monday, tuesday])
    assert np.allclose(before.gains, light, rtol=1e-6)
    assert after.gains == (1.0, 1.0, 1.0)
    xy = before.gaussians.means[:, :2]
    expected = brightness(xy, None)[:, None] * np.array([1.2, 1.0, 0.7]) * light
    assert np.allclose(before.gaussians.colours, expected, rtol=1e-5)


def test_dives_over_different_ground_keep_all_and_their_own_colours(work: Path) -> None:
    far_away = Sim3(np.eye(3), np.array([50.0, 0.0, 0.0]))
    elsewhere = [far_away @ pose for pose in above_plane()]
    monday = DayMap("monday", gaussians(None), sharp_views(None, work))
    tuesday = DayMap(
        "tuesday", gaussians(None, (2, 2, 2)).transform(far_away),
        surfaces_of(elsewhere, [to_plane] * 5, work, SHARP),
    )  # fmt: skip
    for part in combine([monday, tuesday]):
        assert len(part.gaussians.means) == len(gaussians(None).means)
        assert part.gains == (1.0, 1.0, 1.0)


def test_a_gaussian_that_is_nowhere_is_left_out(bare: Callable[[str], DayMap]) -> None:
    day = bare("monday")
    day.gaussians.means[7] = np.nan
    (part,) = combine([day])
    assert len(part.gaussians.means) == len(day.gaussians.means) - 1
    assert np.isfinite(part.gaussians.means).all()
