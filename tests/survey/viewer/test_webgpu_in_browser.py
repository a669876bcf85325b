"""WebGPU and WebGL draw the same picture, and WebGL goes on where WebGPU does not."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.config.service import ViewerConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.viewer.dive_map import CLASSES, COVERAGE
from aquaflow.survey.viewer.finished import open_dive
from aquaflow.survey.viewer.page import ViewerPage
from aquaflow.survey.viewer.seen_water import seen_water
from aquaflow.survey.viewer.splats import splats
from tests.browser import Browser, needs_browser
from tests.survey.viewer.planes import floor

pytestmark = [pytest.mark.ci, needs_browser]

PICTURES = os.environ.get("AQUAFLOW_PAGE_PICTURES")
"""Folder that gets the screenshots, to look at them."""
RENDERERS = ("webgl", "webgpu")
SMALL = 3
"""Grey levels: each of some 30 layers is rounded to 8 bits."""
NO_HASTE = "performance.now = () => 1;"
"""A slow machine leaves no Gaussians out."""
KEEP_DEVICE = """
    const ask = GPUAdapter.prototype.requestDevice;
    GPUAdapter.prototype.requestDevice = async function (...given) {
      return window.device = await ask.apply(this, given);
    };"""
REFUSE = "GPUAdapter.prototype.requestDevice = async () => { throw new Error('busy'); };"
IN_SOFTWARE = {
    "newer": "define(GPUAdapterInfo.prototype, 'isFallbackAdapter', { get: () => true });",
    "older": """
        define(GPUAdapterInfo.prototype, 'isFallbackAdapter', { get: () => undefined });
        define(GPUAdapter.prototype, 'isFallbackAdapter', { get: () => true });""",
}
"""An adapter that is a program, as newer and as older browsers say it."""
NO_ROOM = """
    const make = GPUDevice.prototype.createBuffer;
    GPUDevice.prototype.createBuffer = function (asked) {
      const size = asked.size > 1e5 ? 4 * Math.ceil(this.limits.maxBufferSize / 4 + 1) : asked.size;
      return make.call(this, { ...asked, size });
    };"""
"""An adapter with less room than the map needs."""
HOLD_SECOND_CHUNK = """
    const get = window.fetch;
    window.fetch = async (address, ...given) => {
      if (/^\\/map\\/.*\\/1$/.test(address)) await new Promise(go => { window.go = go; });
      return get(address, ...given);
    };"""
NO_WEBGL = """
    const give = HTMLCanvasElement.prototype.getContext;
    HTMLCanvasElement.prototype.getContext = function (kind, ...given) {
      return kind === 'webgl2' ? null : give.call(this, kind, ...given);
    };"""
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
    """A floor at 5 m before the first camera, in water that takes the red; of two chunks."""
    page = ViewerPage(ViewerConfig(port=0), "floor")
    page.finish()
    plane = floor(step=0.06)
    plane.levels[COVERAGE] = np.where(plane.centres[:, 0] > 0.0, 3, 1).astype(np.uint8)
    water = seen_water([0.5] * 3, [0.0, 0.0, 0.9], [0.5] * 3, [0.0] * 3, [0.5] * 3, [1.0] * 3, 5.0)
    page.show_splats(plane, water, {COVERAGE: CLASSES})
    look_down(page)
    yield page
    page.close()


@pytest.fixture(scope="module")
def near() -> Iterator[ViewerPage]:
    """Gaussians of sigmas to 4000 px, and one whose middle is 1300 px beside the first pose."""
    page = ViewerPage(ViewerConfig(port=0), "near")
    page.finish()
    rotated = [[0.9, 0.1, -0.2, 0.3], [0.8, 0.2, 0.1, -0.4]]
    places = [[0.0, 0.0, 1.0], [0.5, 0.2, 1.2], [3.0, -0.1, 1.1], [-40, -30, 9], [40, 30, 9]]
    turns = [[1, 0, 0, 0], *rotated, [1, 0, 0, 0], [1, 0, 0, 0]]
    scales = [[4.0, 5.0, 0.1], [9.0, 0.1, 0.2], [8.0, 0.2, 0.3], [1, 1, 1], [1, 1, 1]]
    colours = [[0.5, 0.8, 0.7], [0.9, 0.1, 0.1], [0.1, 0.2, 0.9], [0.5] * 3, [0.5] * 3]
    opacities = [0.5, 0.7, 0.8, 0.9, 0.9]
    rows = (np.array(each, np.float32) for each in (places, turns, scales, opacities, colours))
    page.show_splats(splats(*rows, len(places)))
    look_down(page)
    yield page
    page.close()


def look_down(page: ViewerPage) -> None:
    """The path: two poses that see the floor, aslant: what is equally deep has no order."""
    aslant = [0.99, 0.06, 0.12, 0.0]
    page.show_path(np.array([[x, 0, 0, *aslant, 1] for x in (0.0, 1.0)], np.float32))
    page.show_camera(Sim3.identity(), CameraModel(64, 48, 64.0, 64.0, 32.0, 24.0), None)


@pytest.fixture(params=["flat", "mapped"])
def page(request: pytest.FixtureRequest) -> ViewerPage:
    page = request.getfixturevalue(request.param)
    assert isinstance(page, ViewerPage)
    return page


@contextmanager
def opened(page: ViewerPage, profile: Path, *before: str, webgpu: bool = True) -> Iterator[Browser]:
    """A browser that is at the page, for which these scripts were run first."""
    browser = Browser(profile, webgl=True, webgpu=webgpu)
    try:
        browser.emulate(800, 500)
        for script in (NO_HASTE, *before):
            browser.before(script)
        browser.open(page.address)
        browser.wait("window.aquaflowTimes?.first")
        browser.click("#fold")
        yield browser
    finally:
        browser.close()


def drawn_by(browser: Browser) -> str:
    """A canvas has one kind of context, and gives no other."""
    script = "return document.querySelector('#map').getContext(arguments[0]) !== null"
    return "webgpu" if browser.run(script, "webgpu") else "webgl"


def still(browser: Browser, file: Path) -> Picture:
    """[H, W, 3] what is on the screen once the whole map is there and has come to rest."""
    browser.wait("aquaflowTimes.whole && aquaflowTimes.still")
    before, now = None, shot(browser, file)
    while before is None or not np.array_equal(before, now):
        time.sleep(0.4)
        browser.wait("aquaflowTimes.still")
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
    browser.run("document.querySelector('#wipe').click()")
    keep("divided")
    browser.run("document.querySelector('#wipe').click()")
    browser.run(SET, "#colours", "coverage")
    keep("coverage")
    return found


def assert_same(found: Picture, expected: Picture, look: str = "") -> None:
    apart = np.abs(found - expected)
    assert np.percentile(apart, 99.9) <= SMALL, look
    assert apart.mean() < 0.3, look
    assert np.std(expected) > 10, look


def test_both_draw_the_same_picture(page: ViewerPage, tmp_path: Path) -> None:
    pictures = {}
    for renderer in RENDERERS:
        with opened(page, tmp_path / renderer, webgpu=renderer == "webgpu") as browser:
            folder = Path(PICTURES) if PICTURES else tmp_path
            pictures[renderer] = looks(browser, folder, f"{page._exhibit.title}_{renderer}")
            assert drawn_by(browser) == renderer
    for look, expected in pictures["webgl"].items():
        assert_same(pictures["webgpu"][look], expected, look)


def test_both_draw_what_is_wider_than_the_screen_alike(near: ViewerPage, tmp_path: Path) -> None:
    folder = Path(PICTURES) if PICTURES else tmp_path
    pictures = []
    for renderer in RENDERERS:
        with opened(near, tmp_path / renderer, webgpu=renderer == "webgpu") as browser:
            browser.run(SET, "#pose", 0)
            pictures.append(still(browser, folder / f"near_{renderer}.png"))
            assert drawn_by(browser) == renderer
    assert_same(pictures[1], pictures[0])


def test_a_lost_device_is_replaced_by_webgl_on_the_same_page(
    mapped: ViewerPage, tmp_path: Path
) -> None:
    with opened(mapped, tmp_path / "profile", KEEP_DEVICE) as browser:
        browser.run(SET, "#colours", "coverage")
        before = still(browser, tmp_path / "before.png")
        browser.run("window.same = true; window.device.destroy()")
        browser.until(lambda: drawn_by(browser) == "webgl", "WebGL")
        assert_same(still(browser, tmp_path / "after.png"), before)
        assert browser.run("return window.same === true")
        assert browser.text("#said") == ""
        browser.run(SET, "#colours", "picture")
        assert np.abs(still(browser, tmp_path / "picture.png") - before).mean() > 1


def test_a_device_lost_while_the_map_loads_costs_nothing_of_it(
    flat: ViewerPage, tmp_path: Path
) -> None:
    with opened(flat, tmp_path / "whole") as browser:
        whole = still(browser, tmp_path / "whole.png")
    with opened(flat, tmp_path / "lost", KEEP_DEVICE, HOLD_SECOND_CHUNK) as browser:
        browser.wait("window.go")
        assert drawn_by(browser) == "webgpu"
        browser.run("window.device.destroy()")
        browser.until(lambda: drawn_by(browser) == "webgl", "WebGL")
        assert not browser.run("return Boolean(aquaflowTimes.whole)")
        browser.run("window.go()")
        assert_same(still(browser, tmp_path / "lost.png"), whole)
        assert browser.text("#said") == ""


def test_a_map_that_the_adapter_has_no_room_for_is_drawn_whole_by_webgl(
    flat: ViewerPage, tmp_path: Path
) -> None:
    with opened(flat, tmp_path / "webgl", webgpu=False) as browser:
        expected = still(browser, tmp_path / "webgl.png")
    with opened(flat, tmp_path / "webgpu", NO_ROOM) as browser:
        browser.until(lambda: drawn_by(browser) == "webgl", "WebGL")
        assert_same(still(browser, tmp_path / "webgpu.png"), expected)
        assert browser.text("#said") == ""


def test_a_lost_device_is_told_of_where_there_is_no_webgl_either(
    flat: ViewerPage, tmp_path: Path
) -> None:
    with opened(flat, tmp_path / "profile", KEEP_DEVICE, NO_WEBGL) as browser:
        browser.run("window.device.destroy()")
        browser.until(lambda: "no WebGL 2" in browser.text("#view"), "a sentence")


@pytest.mark.parametrize("age", IN_SOFTWARE)
def test_webgl_draws_where_webgpu_is_a_program(flat: ViewerPage, tmp_path: Path, age: str) -> None:
    script = f"const define = Object.defineProperty; {IN_SOFTWARE[age]}"
    with opened(flat, tmp_path / "profile", script) as browser:
        assert drawn_by(browser) == "webgl"


def test_where_the_adapter_refuses_webgl_draws(flat: ViewerPage, tmp_path: Path) -> None:
    with opened(flat, tmp_path / "profile", REFUSE) as browser:
        assert drawn_by(browser) == "webgl"
