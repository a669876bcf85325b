"""The viewer in a real browser: what it draws, measures and keeps, by mouse and by finger."""

from __future__ import annotations

import base64
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest

from aquaflow.config.service import ViewerConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.viewer.dive_map import CLASSES, COVERAGE
from aquaflow.survey.viewer.finished import open_dive
from aquaflow.survey.viewer.levels import RANGE, range_level
from aquaflow.survey.viewer.page import ViewerPage
from aquaflow.survey.viewer.seen_water import seen_water
from aquaflow.survey.viewer.viewer_content import PathPart
from tests.browser import Browser, needs_browser
from tests.survey.viewer.planes import floor

pytestmark = [pytest.mark.ci, needs_browser]

SCREEN = (800, 500)
TABLET = (768, 640)
TABLETS = ((768, 1024), (1024, 768))
"""Upright and lying."""
PICTURES = os.environ.get("AQUAFLOW_PAGE_PICTURES")
"""Folder that gets the screenshots, to look at them."""
CAMERA_ABOVE = """
    document.querySelector('#pose').value = 0;
    document.querySelector('#pose').dispatchEvent(new Event('input'));"""
INK = """
    (canvas => canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data
      .filter((value, k) => k % 4 === 3 && value).length)(document.querySelector('#marks'))"""
"""Pixels that something is drawn on over the map."""
MOMENTS = np.array([[0.0, 4.2, 271.6, 0, 0.0], [75.0, np.nan, 90.0, 0, 0.0]], np.float32)
"""Of the two poses: seconds, depth, heading, and the picture of the first, which is kept."""
Box = tuple[float, float, float, float]


@pytest.fixture(scope="module", params=[False, True], ids=["webgl", "webgpu"])
def webgpu(request: pytest.FixtureRequest) -> bool:
    """Whether the browser has WebGPU beside WebGL."""
    return bool(request.param)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory, webgpu: bool) -> Iterator[Browser]:
    browser = Browser(tmp_path_factory.mktemp("profile"), webgl=True, webgpu=webgpu)
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def page(small_dive: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ViewerPage]:
    """A floor at 5 m that a camera looks straight down on, in water that takes the red."""
    folder = shutil.copytree(small_dive, tmp_path_factory.mktemp("viewed") / "dive")
    page = open_dive(folder, ViewerConfig(port=0, splats=100))
    plane = floor(step=0.1)
    cameras = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    ranges, palette = range_level(plane.centres, cameras, "m")
    classes = np.where(plane.centres[:, 0] > 0.0, 3, 1).astype(np.uint8)
    plane.levels.update({RANGE: ranges, COVERAGE: classes})
    water = seen_water([0.5] * 3, [0.0, 0.0, 0.9], [0.5] * 3, [0.0] * 3, [0.5] * 3, [1.0] * 3, 5.0)
    page.show_splats(plane, water, {RANGE: palette, COVERAGE: CLASSES})
    page.show_path(np.array([[x, 0, 0, 1, 0, 0, 0, 1] for x in (0.0, 1.0)], np.float32), MOMENTS)
    page.show_pictures({0: next(iter((folder / "pictures").glob("*.jpg")))})
    page._exhibit.north = "true north"
    yield page
    page.close()


@pytest.fixture
def shown(browser: Browser, page: ViewerPage) -> Browser:
    """The page, seen from the camera above the floor."""
    show(browser, page, SCREEN)
    return browser


@pytest.fixture
def touched(page: ViewerPage, tmp_path: Path, webgpu: bool) -> Iterator[Browser]:
    """A browser of its own: Chromium that leaves a page it had touched may lose later touches."""
    browser = Browser(tmp_path / "profile", webgl=True, webgpu=webgpu)
    try:
        show(browser, page, TABLET)
        yield browser
    finally:
        browser.close()


def show(browser: Browser, page: ViewerPage, size: tuple[int, int]) -> None:
    browser.emulate(*size)
    browser.open("about:blank")
    browser.open(page.address)
    browser.wait("window.aquaflowTimes && window.aquaflowTimes.whole")
    browser.run(CAMERA_ABOVE)


def colour(browser: Browser, x: float, y: float, tmp_path: Path, name: str = "shot") -> np.ndarray:
    """[3] RGB, mean about a place of the map's own picture, shares of its size."""
    import cv2

    folder = Path(PICTURES) if PICTURES else tmp_path
    file = folder / f"viewer_{name}.png"
    browser.screenshot(file)
    picture = cv2.imread(str(file))
    assert picture is not None
    left, top, width, height = box(browser, "#map")
    column, row = int(left + x * width), int(top + y * height)
    around = picture[row - 6 : row + 7, column - 6 : column + 7]
    return np.asarray(around.reshape(-1, 3).mean(axis=0)[::-1])


def until(browser: Browser, x: float, y: float, tmp_path: Path, wanted: str) -> np.ndarray:
    """The colour there once it is as ``wanted``, of r, g and b; drawing takes time."""
    found = np.zeros(3)

    def reached() -> bool:
        nonlocal found
        found = colour(browser, x, y, tmp_path)
        r, g, b = found
        return bool(eval(wanted, {}, {"r": r, "g": g, "b": b}))

    browser.until(reached, f"{wanted} at {x}, {y}")
    return found


def drawn_by_webgpu(browser: Browser) -> bool:
    """A canvas has one kind of context, and gives no other."""
    return bool(browser.run("return document.querySelector('#map').getContext('webgpu') !== null"))


def box(browser: Browser, selector: str) -> Box:
    said = browser.run(
        "const r = document.querySelector(arguments[0]).getBoundingClientRect();"
        "return [r.x, r.y, r.width, r.height]",
        selector,
    )
    return said[0], said[1], said[2], said[3]


def put(browser: Browser, selector: str, value: object) -> None:
    """What a hand does with a slider or a list."""
    browser.run(
        "const e = document.querySelector(arguments[0]); e.value = arguments[1];"
        "e.dispatchEvent(new Event('input')); e.dispatchEvent(new Event('change'))",
        selector,
        value,
    )


def point(browser: Browser, x: float, y: float, count: int) -> None:
    """Click at a share of the map; wait until so many points are marked."""
    left, top, width, height = box(browser, "#map")
    browser.tap(left + x * width, top + y * height)
    browser.wait(f"Number(document.querySelector('#tools').dataset.points) === {count}")


def test_the_map_is_drawn_by_webgpu_where_the_browser_has_it(shown: Browser, webgpu: bool) -> None:
    assert drawn_by_webgpu(shown) == webgpu


def test_the_map_is_drawn_and_water_comes_by_its_slider(shown: Browser, tmp_path: Path) -> None:
    until(shown, 0.5, 0.5, tmp_path, "abs(r - b) < 12 and r > 90")
    put(shown, "#water", 100)
    until(shown, 0.5, 0.5, tmp_path, "b > r + 60")
    put(shown, "#through", 1)
    until(shown, 0.5, 0.5, tmp_path, "abs(r - b) < 25")


def test_a_finger_draws_the_divider_between_with_and_without_water(
    touched: Browser, tmp_path: Path
) -> None:
    touched.click("#wipe")
    until(touched, 0.25, 0.5, tmp_path, "b > r + 60")
    until(touched, 0.75, 0.5, tmp_path, "abs(r - b) < 12")
    x, y, width, height = box(touched, "#divider")
    left, _, whole, _ = box(touched, "#map")
    touched.swipe((x + width / 2, y + height / 2), (left + 0.1 * whole, y + height / 2))
    until(touched, 0.25, 0.5, tmp_path, "abs(r - b) < 12")
    stands = float(touched.run("return parseFloat(document.querySelector('#divider').style.left)"))
    assert abs(stands - 10.0) < 2.0


def test_coverage_colours_the_map_and_says_what_colours_mean(
    shown: Browser, tmp_path: Path
) -> None:
    put(shown, "#colours", "coverage")
    until(shown, 0.75, 0.5, tmp_path, "g > r + 40")
    until(shown, 0.25, 0.5, tmp_path, "r > g + 40")
    assert "too far for this water" in shown.text("#legend")


def test_what_is_far_from_the_path_is_hidden(shown: Browser, tmp_path: Path) -> None:
    until(shown, 0.5, 0.5, tmp_path, "r > 90")
    put(shown, "#within", 40)
    until(shown, 0.5, 0.5, tmp_path, "r < 40")


def test_a_crop_keeps_what_lies_in_its_box_for_eyes_and_tools(
    shown: Browser, page: ViewerPage, tmp_path: Path
) -> None:
    until(shown, 0.75, 0.5, tmp_path, "r > 90")
    shown.click("#crop summary")
    shown.wait("document.querySelector('#crop input')")
    put(shown, "[data-side='x to']", 100)
    until(shown, 0.75, 0.5, tmp_path, "r < 40")
    until(shown, 0.25, 0.5, tmp_path, "r > 90")
    shown.click("[data-tool=distance]")
    left, top, width, height = box(shown, "#map")
    shown.tap(left + 0.75 * width, top + 0.5 * height)
    shown.wait("document.querySelector('#result').innerText.includes('nothing there')")
    point(shown, 0.25, 0.5, 1)
    shown.wait("/crop=,,,-?[\\d.e-]+,,/.test(location.hash)")
    address = page.address + shown.run("return location.hash")
    shown.open("about:blank")
    shown.open(address)
    shown.wait("window.aquaflowTimes && window.aquaflowTimes.whole")
    until(shown, 0.75, 0.5, tmp_path, "r < 40")
    assert shown.text("#crop summary") == "Crop: on"
    shown.click("#crop summary")
    shown.click("#crop button")
    until(shown, 0.75, 0.5, tmp_path, "r > 90")


def test_what_floats_is_hidden_until_all_is_asked_for(
    shown: Browser, page: ViewerPage, tmp_path: Path
) -> None:
    before = page._exhibit.map
    plane = replace(floor(step=0.1), floaters=1)
    plane.centres[0], plane.scales[0], plane.colours[0] = (0, 0, 2), 0.3, (0.9, 0.1, 0.1)
    try:
        page.show_splats(plane)
        show(shown, page, SCREEN)
        assert shown.text("#floaters").strip() == "Show all: one that floats is hidden"
        until(shown, 0.5, 0.5, tmp_path, "abs(r - b) < 12 and r > 90")
        shown.click("#all")
        until(shown, 0.5, 0.5, tmp_path, "r > b + 60")
        shown.wait("/all=1/.test(location.hash)")
    finally:
        page._exhibit.map = before


def test_two_points_are_a_distance_and_three_an_area(shown: Browser) -> None:
    shown.click("[data-tool=distance]")
    point(shown, 0.4, 0.5, 1)
    point(shown, 0.6, 0.5, 2)
    shown.wait("document.querySelector('#result').innerText.includes('\u00b1')")
    shown.click("[data-tool=area]")
    for count, at in enumerate([(0.4, 0.4), (0.6, 0.4), (0.5, 0.6)], 1):
        point(shown, *at, count)
    shown.wait("document.querySelector('#result').innerText.includes('\u00b2')")


def test_a_profile_is_drawn_as_a_line(shown: Browser) -> None:
    shown.click("[data-tool=profile]")
    point(shown, 0.4, 0.5, 1)
    point(shown, 0.6, 0.5, 2)
    shown.wait("document.querySelector('#chart').getBoundingClientRect().height > 50")
    assert shown.run("return document.querySelectorAll('#chart path').length") == 1


def test_a_cross_section_is_drawn_with_its_axes_and_saved(shown: Browser, tmp_path: Path) -> None:
    shown.click("[data-tool=profile]")
    point(shown, 0.4, 0.5, 1)
    point(shown, 0.6, 0.5, 2)
    shown.click("#section-form button")
    shown.wait("document.querySelector('#section canvas')?.width > 100")
    if PICTURES:
        shown.screenshot(Path(PICTURES) / "viewer_section.png")
    floor_px, above_px = shown.run(DARK)
    assert 0.5 < floor_px < 8.0
    assert above_px == 0
    x, y, width, height = box(shown, "#section")
    assert x >= 0 <= y
    assert x + width <= SCREEN[0]
    assert y + height <= SCREEN[1]
    shown.run(SAVED)
    shown.click("#section button")
    shown.wait("window.saved")
    assert shown.run("return window.saved[0]") == "dive_AquaFlow_section.png"
    shown.click("#section button:last-child")
    shown.wait("!document.querySelector('#section')")


def test_pointing_beside_the_map_says_so_and_the_next_point_is_found(shown: Browser) -> None:
    shown.click("#home")
    shown.click("[data-tool=distance]")
    left, top, _, height = box(shown, "#map")
    shown.tap(left + 3, top + height - 3)
    shown.wait("document.querySelector('#result').innerText.includes('nothing there')")
    shown.run(CAMERA_ABOVE)
    point(shown, 0.5, 0.5, 1)


def test_a_note_is_kept_in_the_dive_shown_and_removed(shown: Browser) -> None:
    shown.click("[data-tool=note]")
    point(shown, 0.5, 0.5, 1)
    shown.type("#note-text", "<b>wreck</b>\ue007")
    shown.wait("document.querySelector('#notes').innerText.includes('<b>wreck</b>')")
    shown.run("location.reload()")
    shown.wait("document.querySelector('#notes')?.innerText.includes('<b>wreck</b>')")
    shown.click("#notes button")
    shown.wait("!document.querySelector('#notes li')")


def test_a_view_is_kept_in_the_dive_led_back_to_and_removed(shown: Browser) -> None:
    before = eye(shown)[0]
    put(shown, "#water", 40)
    shown.wait("location.hash === '#pose=0&water=40'")
    shown.click("#views summary")
    shown.wait("document.querySelector('#views input')")
    shown.type("#views input", "<i>bow</i>\ue007")
    shown.wait("document.querySelector('#views a')?.innerText === '<i>bow</i>'")
    put(shown, "#water", 0)
    shown.click("#home")
    assert moved(shown, before) > 1.0
    shown.click("#views a")
    shown.wait("document.querySelector('#water').value === '40'")
    assert moved(shown, before) < 1e-3
    shown.click("#views li button")
    shown.wait("!document.querySelector('#views a')")


def test_three_points_on_something_level_turn_the_map(browser: Browser, page: ViewerPage) -> None:
    page._tools.others["level"] = lambda given: {"words": f"level by {len(given['places'])}"}
    page._exhibit.can = page._tools.can()
    try:
        show(browser, page, SCREEN)
        browser.click("[data-tool=level]")
        for count, at in enumerate([(0.4, 0.4), (0.6, 0.4), (0.5, 0.6)], 1):
            point(browser, *at, count)
        browser.click("#level-form button")
        browser.wait("document.querySelector('#result').innerText === 'level by 3'")
    finally:
        del page._tools.others["level"]
        page._exhibit.can = page._tools.can()


def test_the_cameras_picture_stands_beside_the_map_from_its_pose(shown: Browser) -> None:
    shown.click("#beside")
    shown.wait("document.querySelector('#picture').naturalWidth > 0")
    assert box(shown, "#seen")[2] > 100
    assert shown.text("#caption") == "0:00"
    assert shown.text("#where") == "0:00 of 1:15 \u00b7 4.2 m deep \u00b7 heading 272\u00b0"
    put(shown, "#pose", 1)
    assert shown.text("#caption") == "of 0:00: 75.0 s before this pose"
    assert shown.text("#where") == "1:15 of 1:15 \u00b7 heading 90\u00b0"


def test_the_slider_says_utc_where_the_dive_knows_it(browser: Browser, page: ViewerPage) -> None:
    page._exhibit.began = datetime(2026, 11, 24, 23, 59, 30, tzinfo=timezone.utc)
    try:
        browser.emulate(*SCREEN)
        browser.open("about:blank")
        browser.open(page.address)
        browser.wait("window.aquaflowTimes && window.aquaflowTimes.whole")
        put(browser, "#pose", 1)
        assert browser.text("#where") == "00:00:45 UTC \u00b7 heading 90\u00b0"
    finally:
        page._exhibit.began = None


def test_each_pose_of_a_site_says_its_dive_and_has_its_lens(
    browser: Browser, page: ViewerPage, tmp_path: Path
) -> None:
    lens = CameraModel(64, 48, 64.0, 64.0, 32.0, 24.0)
    began = datetime(2026, 11, 24, 12, 0, 0, tzinfo=timezone.utc)
    parts = [PathPart("monday", 0, None, lens), PathPart("tuesday", 2, began, lens.resize(32, 24))]
    poses = np.array([[x, 0, 0, 1, 0, 0, 0, 1] for x in (0.0, 1.0, 9.0, 9.5)], np.float32)
    seen = page._exhibit.path
    try:
        page.show_path(poses, np.tile(MOMENTS, (2, 1)), parts=parts)
        show(browser, page, SCREEN)
        put(browser, "#pose", 1)
        assert browser.text("#where").startswith("monday \u00b7 1:15 of 1:15")
        assert browser.run("return aquaflowEye.lens.width") == 64
        put(browser, "#pose", 3)
        assert browser.text("#where").startswith("tuesday \u00b7 12:01:15 UTC")
        assert browser.run("return aquaflowEye.lens.width") == 32
    finally:
        page.show_path(seen[:, :8], seen[:, 8:])


def eye(browser: Browser) -> tuple[np.ndarray, float]:
    """Where the eye is [3], and its distance from what it turns about."""
    place, target = browser.run("return [aquaflowEye.place, aquaflowEye.target]")
    return np.array(place), float(np.linalg.norm(np.subtract(place, target)))


def moved(browser: Browser, before: np.ndarray) -> float:
    """How far the eye is from where it was."""
    return float(np.linalg.norm(eye(browser)[0] - before))


@pytest.mark.parametrize("size", [TABLETS[0], pytest.param(TABLETS[1], marks=pytest.mark.slow)])
def test_one_finger_turns_two_move_and_zoom_and_a_tap_points(
    touched: Browser, size: tuple[int, int], tmp_path: Path
) -> None:
    touched.emulate(*size)
    touched.click("#home")
    left, top, width, height = box(touched, "#map")
    x, y = left + width / 2, top + height / 2
    _, away = eye(touched)
    right = np.array(touched.run("return aquaflowEye.axes[0]"))
    touched.swipe((x, y), (x + 90, y))
    touched.until(
        lambda: right @ touched.run("return aquaflowEye.axes[0]") < 0.98, "one finger turns"
    )
    assert eye(touched)[1] == pytest.approx(away, rel=1e-6)
    touched.two_fingers(((x - 40, y), (x + 40, y)), ((x - 80, y), (x + 80, y)))
    touched.until(lambda: eye(touched)[1] < 0.6 * away, "two fingers zoom")
    place, nearer = eye(touched)
    touched.two_fingers(((x - 40, y), (x + 40, y)), ((x - 40, y + 60), (x + 40, y + 60)))
    touched.until(lambda: moved(touched, place) > 0.05 * nearer, "two fingers move")
    assert eye(touched)[1] == pytest.approx(nearer, rel=0.05)
    touched.run(CAMERA_ABOVE)
    touched.click("[data-tool=distance]")
    left, top, width, height = box(touched, "#map")
    for count, share in ((1, 0.45), (2, 0.55)):
        touched.touch(left + share * width, top + 0.5 * height)
        touched.wait(f"Number(document.querySelector('#tools').dataset.points) === {count}")
    touched.wait("document.querySelector('#result').innerText.includes('\u00b1')")
    if PICTURES:
        touched.screenshot(Path(PICTURES) / f"viewer_tablet_{size[0]}.png")


@pytest.mark.parametrize("size", TABLETS)
def test_on_a_tablet_everything_is_within_reach(shown: Browser, size: tuple[int, int]) -> None:
    shown.emulate(*size)
    shown.click("#beside")
    for selector in ("#map", "#seen", "#panel", "#time", "#beside", "#pose", "#where", "#fold"):
        x, y, width, height = box(shown, selector)
        assert width > 20, selector
        assert x >= 0 <= y, selector
        assert x + width <= size[0] + 1, selector
        assert y + height <= size[1] + 1, selector
    assert box(shown, "#map")[2] >= 0.3 * size[0] or box(shown, "#map")[3] >= 0.3 * size[1]
    small = shown.run(
        "return [...document.querySelectorAll('button')].filter(b => b.offsetParent &&"
        " b.getBoundingClientRect().height < 44).map(b => b.textContent)"
    )
    assert small == []


def test_a_live_dive_is_followed(browser: Browser, tmp_path: Path) -> None:
    page = ViewerPage(ViewerConfig(port=0), "live")
    try:
        browser.emulate(*SCREEN)
        browser.open(page.address)
        browser.wait("document.querySelector('#said').innerText.includes('no map so far')")
        camera = CameraModel(64, 48, 64.0, 64.0, 32.0, 24.0)
        for turn, rgb in enumerate([(0.8, 0.1, 0.1), (0.1, 0.8, 0.1)]):
            page.show_splats(floor(step=0.2, rgb=rgb))
            page.show_path(np.tile([[0, 0, 0, 1, 0, 0, 0, 1]], (turn + 2, 1)).astype(np.float32))
            picture = np.full((48, 64, 3), 90, np.uint8)
            page.show_camera(Sim3.identity(), camera, picture)
            page.show_health(f"turn {turn}")
            browser.wait(f"document.querySelector('#health').innerText === 'turn {turn}'")
            if turn == 0:
                browser.wait("!document.querySelector('#time').hidden")
                browser.click("#beside")
            until(browser, 0.5, 0.5, tmp_path, ("r > g + 60", "g > r + 60")[turn])
        browser.wait("document.querySelector('#where').innerText === 'pose 3 of 3, now'")
        browser.wait("document.querySelector('#picture').naturalWidth === 64")
        assert browser.text("#caption") == "now"
    finally:
        page.close()


def test_a_dive_without_a_map_shows_its_path_and_makes_way_for_the_finished_dive(
    browser: Browser,
) -> None:
    live = ViewerPage(ViewerConfig(port=0), "grows")
    port = int(live.address.rstrip("/").rpartition(":")[2])
    try:
        browser.emulate(*SCREEN)
        browser.open(live.address)
        rows = np.array([[x, 0, 0, 1, 0, 0, 0, 1] for x in (0.0, 1.0, 2.0)], np.float32)
        live.show_path(rows)
        browser.wait(f"({INK}) > 100")
        assert not browser.run("return document.querySelector('#tools').checkVisibility()")
        browser.run("location.hash = '#at=9,9,9&to=0,0,0'")
    finally:
        live.close()
    finished = ViewerPage(ViewerConfig(port=port), "is finished")
    try:
        finished.show_path(rows)
        finished.show_splats(floor(step=0.2))
        finished.finish()
        browser.wait("window.aquaflowTimes?.whole && document.title === 'is finished'")
        assert not browser.run("return location.hash.includes('9,9,9')")
        assert browser.run("return document.querySelector('#tools').checkVisibility()")
    finally:
        finished.close()


@pytest.mark.parametrize("width", [390, 800, 1280])
def test_the_slider_is_long_and_nothing_is_wider_than_the_window(
    shown: Browser, width: int
) -> None:
    shown.emulate(width, 780)
    assert shown.run("return document.documentElement.scrollWidth <= innerWidth")
    (_, panel_top, _, panel), (_, top, length, _) = box(shown, "#panel"), box(shown, "#pose")
    assert length >= 300
    assert panel_top + panel <= top
    assert shown.text("#where").startswith("0:00 of 1:15")


DARK = """
    const canvas = document.querySelector('#section canvas'), pen = canvas.getContext('2d');
    const { width, height } = canvas;
    const dark = (...of) => pen.getImageData(...of).data.filter((v, i) => i % 4 === 0 && v < 200);
    const wide = width - 92, at = y => dark(70, y, wide, 8).length;
    return [at((height - 4) / 2 - 4) / wide, at(46)];"""
"""Pixels of ink at half the height of what is drawn, of its width; and at its top."""
ARROW_LEFT = "\ue012"
"""A key, as WebDriver names it."""
SAVED = """
    HTMLAnchorElement.prototype.click = function () {
      window.saved = [this.download, this.href];
    };"""
FOCAL = """
    const map = document.querySelector('#map');
    return aquaflowEye.optics(map.clientWidth, map.clientHeight).fx;"""


def test_an_address_leads_back_to_its_view(shown: Browser, page: ViewerPage) -> None:
    shown.wait("location.hash === '#pose=0'")
    shown.run("document.querySelector('#marks').focus();")
    shown.press(ARROW_LEFT)
    put(shown, "#water", 40)
    shown.wait("/^#at=.*&to=.*&water=40$/.test(location.hash)")
    address, before = page.address + shown.run("return location.hash"), eye(shown)[0]
    shown.open("about:blank")
    shown.open(address)
    shown.wait("window.aquaflowTimes && window.aquaflowTimes.whole")
    assert eye(shown)[0] == pytest.approx(before, abs=1e-3)
    assert shown.run("return document.querySelector('#water').value") == "40"
    shown.run("location.hash = '#pose=1';")
    shown.wait("aquaflowEye.lens && aquaflowEye.place[0] === 1")
    assert shown.run("return document.querySelector('#water').value") == "0"
    shown.run("location.hash = '#pose=99';")  # not of this dive: the view stays
    shown.wait("location.hash === '#pose=99'")
    assert shown.run("return aquaflowEye.place[0]") == 1


def test_a_saved_picture_has_a_scale_and_north(shown: Browser, tmp_path: Path) -> None:
    """The camera is 5 m above the floor; north is to its right."""
    import cv2

    on_screen = colour(shown, 0.5, 0.5, tmp_path)
    shown.run(SAVED)
    shown.click("#shot")
    shown.wait("window.saved")
    name, address = shown.run("return window.saved")
    assert name == "dive_AquaFlow.png"
    data = base64.b64decode(address.removeprefix("data:image/png;base64,"))
    if PICTURES:
        (Path(PICTURES) / "viewer_saved.png").write_bytes(data)
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    height, width = picture.shape[:2]
    middle = picture[height // 2 - 6 : height // 2 + 7, width // 2 - 6 : width // 2 + 7]
    np.testing.assert_allclose(middle.reshape(-1, 3).mean(axis=0)[::-1], on_screen, atol=6.0)
    focal = shown.run(FOCAL)
    foot = picture[height - 24 : height - 20, 16 : width // 4 + 40]
    bar = (foot.min(axis=2).max(axis=0) > 200).sum()
    lengths = np.array([0.1, 0.2, 0.5, 1.0, 2.0, 5.0])
    expected = lengths[lengths * focal / 5.0 <= 0.25 * width].max() * focal / 5.0
    assert bar == pytest.approx(expected, rel=0.03)
    across = picture[50, width - 50 - 20 : width - 50 + 21].min(axis=1)
    assert across[-1] > 200
    assert across[0] < 120
