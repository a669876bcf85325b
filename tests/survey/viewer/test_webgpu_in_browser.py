"""WebGPU and WebGL draw the same picture, and WebGL goes on where WebGPU does not."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.config.service import ViewerConfig
from aquaflow.survey.viewer.dive_map import CLASSES, COVERAGE
from aquaflow.survey.viewer.finished import open_dive
from aquaflow.survey.viewer.page import ViewerPage
from aquaflow.survey.viewer.seen_water import seen_water
from tests.browser import Browser, needs_browser
from tests.survey.viewer.planes import floor

pytestmark = [pytest.mark.ci, needs_browser]

PICTURES = os.environ.get("AQUAFLOW_PAGE_PICTURES")
"""Folder that gets the screenshots, to look at them."""
WAYS = ("webgl", "webgpu")
SMALL = 3
"""Grey levels: each of some 30 layers is rounded to 8 bits."""
KEEP_DEVICE = """
    const ask = GPUAdapter.prototype.requestDevice;
    GPUAdapter.prototype.requestDevice = async function (...given) {
      return window.device = await ask.apply(this, given);
    };"""
REFUSE = "GPUAdapter.prototype.requestDevice = async () => { throw new Error('busy'); };"
SET = """
    const e = document.querySelector(arguments[0]); e.value = arguments[1];
    for (const kind of ['input', 'change']) e.dispatchEvent(new Event(kind));"""
Picture = npt.NDArray[np.int64]


@pytest.fixture(scope="module")
def mapped(small_dive: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ViewerPage]:
    """A map that was made of a recording."""
    folder = shutil.copytree(small_dive, tmp_path_factory.mktemp("viewed") / "dive")
    page = open_dive(folder, ViewerConfig(port=0, splats=100_000))
    yield page
    page.close()


@pytest.fixture(scope="module")
def flat() -> Iterator[ViewerPage]:
    """A floor at 5 m before the first camera, in water that takes the red."""
    page = ViewerPage(ViewerConfig(port=0), "floor", live=False)
    plane = floor(step=0.1)
    plane.levels[COVERAGE] = np.where(plane.centres[:, 0] > 0.0, 3, 1).astype(np.uint8)
    water = seen_water([0.5] * 3, [0.0, 0.0, 0.9], [0.5] * 3, [0.0] * 3, [0.5] * 3, [1.0] * 3, 5.0)
    page.show_splats(plane, water, {COVERAGE: CLASSES})
    page.show_path(np.array([[x, 0, 0, 1, 0, 0, 0, 1] for x in (0.0, 1.0)], np.float32))
    yield page
    page.close()


@pytest.fixture(params=["flat", "mapped"])
def page(request: pytest.FixtureRequest) -> ViewerPage:
    page = request.getfixturevalue(request.param)
    assert isinstance(page, ViewerPage)
    return page


def opened(page: ViewerPage, profile: Path, way: str, before: str = "") -> Browser:
    browser = Browser(profile, webgl=True, webgpu=way == "webgpu")
    browser.emulate(640, 420)
    browser.before(before)
    browser.open(page.address)
    browser.wait("window.aquaflowTimes?.whole && aquaflowTimes.first")
    return browser


def drawn_by(browser: Browser) -> str:
    """A canvas has one kind of context, and gives no other."""
    script = "return document.querySelector('#map').getContext(arguments[0]) !== null"
    return "webgpu" if browser.run(script, "webgpu") else "webgl"


def still(browser: Browser, file: Path) -> Picture:
    """[H, W, 3] what is on the screen once it has come to rest."""
    before, now = None, shot(browser, file)
    while before is None or not np.array_equal(before, now):
        time.sleep(0.4)
        before, now = now, shot(browser, file)
    return now


def shot(browser: Browser, file: Path) -> Picture:
    browser.screenshot(file)
    return np.asarray(cv2.imread(str(file)), np.int64)


def looks(browser: Browser, folder: Path, name: str) -> dict[str, Picture]:
    """The map in its different looks."""
    found = {}

    def keep(look: str) -> None:
        found[look] = still(browser, folder / f"{name}_{look}.png")

    keep("whole")
    browser.run(SET, "#pose", 1)
    keep("pose")
    browser.run(SET, "#water", 100)
    keep("water")
    browser.run(SET, "#through", 20)
    browser.click("#wipe")
    keep("divided")
    browser.click("#wipe")
    browser.run(SET, "#colours", "coverage")
    keep("coverage")
    return found


def test_both_draw_the_same_picture(page: ViewerPage, tmp_path: Path) -> None:
    pictures = {}
    for way in WAYS:
        browser = opened(page, tmp_path / way, way)
        try:
            folder = Path(PICTURES) if PICTURES else tmp_path
            pictures[way] = looks(browser, folder, f"{page._exhibit.title}_{way}")
            assert drawn_by(browser) == way
        finally:
            browser.close()
    for look, expected in pictures["webgl"].items():
        apart = np.abs(pictures["webgpu"][look] - expected)
        assert np.percentile(apart, 99.9) <= SMALL, look
        assert apart.mean() < 0.3, look
        assert np.std(expected) > 10, look


def test_a_lost_device_is_replaced_by_webgl_on_the_same_page(
    mapped: ViewerPage, tmp_path: Path
) -> None:
    browser = opened(mapped, tmp_path / "profile", "webgpu", KEEP_DEVICE)
    try:
        browser.run(SET, "#colours", "coverage")
        before = still(browser, tmp_path / "before.png")
        browser.run("window.same = true; window.device.destroy()")
        browser.until(lambda: drawn_by(browser) == "webgl", "WebGL")
        after = still(browser, tmp_path / "after.png")
        assert browser.run("return window.same === true")
        assert np.percentile(np.abs(after - before), 99.9) <= SMALL
        browser.run(SET, "#colours", "picture")
        assert np.abs(still(browser, tmp_path / "picture.png") - after).mean() > 1
    finally:
        browser.close()


def test_where_the_adapter_refuses_webgl_draws(flat: ViewerPage, tmp_path: Path) -> None:
    browser = opened(flat, tmp_path / "profile", "webgpu", REFUSE)
    try:
        assert drawn_by(browser) == "webgl"
    finally:
        browser.close()
