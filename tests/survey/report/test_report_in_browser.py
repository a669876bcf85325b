"""The report in a real browser: how its pictures lie on narrow and wide windows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from aquaflow.survey.report.data import CameraSummary, HeldOutExample, ReefRow, ReportData
from aquaflow.survey.report.page import render_report
from tests.browser import Browser, needs_browser

pytestmark = [pytest.mark.ci, needs_browser]

ROWS = """
const rows = {};
for (const each of document.querySelectorAll(".views figure")) {
  const top = Math.round(each.getBoundingClientRect().top);
  rows[top] = (rows[top] || 0) + 1;
}
return Object.keys(rows).map(Number).sort((a, b) => a - b).map(top => rows[top]);
"""
"""Pictures in each row, from above."""
TORN = """
const pen = document.createElement("canvas").getContext("2d"), torn = [];
for (const cell of document.querySelectorAll("td")) {
  pen.font = getComputedStyle(cell).font;
  const inside = cell.clientWidth - parseFloat(getComputedStyle(cell).paddingRight);
  const words = cell.textContent.split(" ");
  torn.push(...words.filter(word => pen.measureText(word).width > inside + 1));
}
return torn;
"""
"""Words of tables that are wider than their cell."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    browser = Browser(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


def example(pictures: int) -> HeldOutExample:
    image = np.full((36, 64, 3), 90, np.uint8)
    restored = image if pictures > 2 else None
    confidence = image[..., 0] if pictures > 3 else None
    return HeldOutExample("frame 8", image, image, restored, 24.1, 0.8, confidence)


@pytest.mark.parametrize("pictures", [2, 3, 4])
@pytest.mark.parametrize("width", [390, 800, 1280])
def test_no_row_of_a_views_pictures_is_shorter_than_the_others(
    browser: Browser, tmp_path: Path, pictures: int, width: int
) -> None:
    camera = CameraSummary(640, 360, 544.0, "guessed")
    file = tmp_path / "report.html"
    file.write_text(render_report(ReportData("d", camera, {}, examples=[example(pictures)])))
    browser.emulate(width, 900)
    browser.open(file.as_uri())
    rows = browser.run(ROWS)
    assert sum(rows) == pictures
    assert len(set(rows)) == 1


@pytest.mark.parametrize("width", [390, 800, 1280])
def test_no_table_tears_its_words_or_widens_the_page(
    browser: Browser, tmp_path: Path, width: int
) -> None:
    camera = CameraSummary(640, 360, 544.0, "guessed")
    meaning = "of the camera; its interval reaches down by what jitter may have added"
    row = ReefRow("surveyed area", "123.46 \u00b1 12.35 m\u00b2", "100.25 to 150.75", meaning)
    file = tmp_path / "report.html"
    file.write_text(render_report(ReportData("d", camera, {}, reef=[row] * 3)))
    browser.emulate(width, 900)
    browser.open(file.as_uri())
    assert browser.run(TORN) == []
    assert browser.run("return document.documentElement.scrollWidth <= innerWidth")
