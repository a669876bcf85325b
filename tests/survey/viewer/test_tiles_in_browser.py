"""The detail of a large map in a real browser: it comes where the eye is, and goes again."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.config.service import ViewerConfig
from aquaflow.dive.dive import Dive
from aquaflow.dive.ply import PlyGaussians, write_ply
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.viewer import dive_map, map_tiles
from aquaflow.survey.viewer.dive_map import DiveMap, read_map
from aquaflow.survey.viewer.page import ViewerPage
from aquaflow.telemetry.world_frame import WorldFrame
from tests.browser import Browser, needs_browser

pytestmark = [pytest.mark.ci, needs_browser]

LENGTH, STEP, ROW = 30.0, 0.05, 1024
"""m, of a strip 2 m wide; between its Gaussians. Gaussians of a row of the page's texture."""
NEAR, FAR = "#at={x},1,0.6&to={x},1.3,2", "#at=15,-30,-60&to=15,1,2"
PICTURES = os.environ.get("AQUAFLOW_PAGE_PICTURES")
"""Folder that gets the screenshots, to look at them."""


@pytest.fixture(scope="module", params=[False, True], ids=["webgl", "webgpu"])
def browser(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Browser]:
    browser = Browser(tmp_path_factory.mktemp("profile"), webgl=True, webgpu=bool(request.param))
    browser.emulate(400, 300)
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def strip(tmp_path_factory: pytest.TempPathFactory) -> DiveMap:
    """Fine stripes on the ground: those of which the base shows one of twenty Gaussians."""
    folder = tmp_path_factory.mktemp("dive")
    x, y = (each.ravel() for each in np.meshgrid(np.arange(0, LENGTH, STEP), np.arange(0, 2, STEP)))
    count, rng = len(x), np.random.default_rng(0)
    light = np.where(np.floor(x / 0.2) % 2 == 0, 0.9, 0.1)
    scales = STEP * np.exp(rng.normal(-0.5, 0.2, (count, 1))) * np.array([1.0, 1.0, 0.1])
    splats = PlyGaussians(
        np.column_stack([x, y, np.full(count, 2.0)]), np.tile([1.0, 0, 0, 0], (count, 1)),
        scales, np.full(count, 0.95), np.repeat(light[:, None], 3, axis=1),
    )  # fmt: skip
    write_ply(folder / "map.ply", splats)
    with pytest.MonkeyPatch.context() as patch:
        for module in (dive_map, map_tiles):
            patch.setattr(module, "BASE", ROW)
            patch.setattr(module, "LEAST_BUDGET", ROW)
        patch.setattr(map_tiles, "MOST_IN_TILE", 1000)
        path = [Sim3(np.eye(3), np.array([k, 1.0, 0.0])) for k in range(int(LENGTH))]
        found = read_map(Dive(folder), folder / "map.ply", path, WorldFrame.unknown(), 8 * ROW)
        assert found.packed.description()["count"] == ROW
        return found


@pytest.fixture
def page(strip: DiveMap) -> Iterator[ViewerPage]:
    page = ViewerPage(ViewerConfig(port=0), "strip")
    page.finish()
    page.show_packed(strip.packed, lambda: strip.splats, None, strip.palettes)
    yield page
    page.close()


def settled(browser: Browser, view: str) -> int:
    """The number of parts that are drawn once no more come."""
    browser.run("location.hash = arguments[0]; return 1", view)
    parts, since = -1, time.monotonic()
    while time.monotonic() - since < 3.0:
        now = browser.run("return window.aquaflowTimes.tiles")
        if now != parts:
            parts, since = now, time.monotonic()
        time.sleep(0.1)
    browser.wait("window.aquaflowTimes.still")
    return parts


def picture(browser: Browser, file: Path) -> np.ndarray:
    browser.screenshot(file)
    if PICTURES:
        browser.screenshot(Path(PICTURES) / file.name)
    shown = cv2.imread(str(file))
    return shown[60:160, 40:150].astype(float)  # left of the panel


def test_detail_comes_where_the_eye_is_and_stays_within_the_budget(
    browser: Browser, page: ViewerPage, tmp_path: Path
) -> None:
    browser.open(page.address)
    browser.wait("window.aquaflowTimes?.whole")
    assert settled(browser, FAR) == 0
    for x in (5, 24):
        parts = settled(browser, NEAR.format(x=x))
        assert 2 <= parts <= 14  # of 46: 7 rows are left for them
        near = picture(browser, tmp_path / f"near_{x}.png")
        # Dark and light stripes, and no gaps through which the page's own dark is seen.
        assert np.percentile(near, 90) > 150.0
        assert np.ptp(near.mean(axis=2).mean(axis=0)) > 60.0
