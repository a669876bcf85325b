"""The path over the map, drawn by the page's own code in a real browser."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from aquaflow.config.service import ViewerConfig
from aquaflow.survey.viewer.finished import open_dive
from aquaflow.survey.viewer.page import ViewerPage
from tests.browser import Browser, needs_browser

pytestmark = [pytest.mark.ci, needs_browser]


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    browser = Browser(tmp_path / "profile", webgl=True)
    yield browser
    browser.close()


@pytest.fixture
def page(small_dive: Path, tmp_path: Path) -> Iterator[ViewerPage]:
    folder = shutil.copytree(small_dive, tmp_path / "dive")
    page = open_dive(folder, ViewerConfig(port=0))
    yield page
    page.close()


COVERED = """
return import('/client/marks.js').then(({ Marks, ROW }) => {
  const [lines, per] = [arguments[0], 40], canvas = document.createElement('canvas');
  canvas.style = 'position: fixed; width: 400px; height: 400px';
  document.body.append(canvas);
  const marks = new Marks(canvas), rows = new Float32Array(ROW * lines * per);
  for (let i = 0; i < lines * per; i++) {
    const line = Math.floor(i / per), along = (i % per) / (per - 1);
    const x = line % 2 ? 1 - along : along, y = line / (lines - 1);
    rows.set([100 + 200 * x, 100 + 200 * y, 1], ROW * i);
    rows[ROW * i + 7] = 1;
  }
  marks.setPath(rows, [{ first: 0 }]);
  marks.draw({ lens: null, optics: () => null, project: point => point });
  const pen = canvas.getContext('2d'), square = [100, 100, 200, 200].map(v => v * devicePixelRatio);
  const inside = pen.getImageData(...square).data.filter((value, k) => k % 4 === 3);
  canvas.remove();
  return inside.reduce((sum, value) => sum + value, 0) / 255 / inside.length;
});"""
"""Share of a square of 200 px that a path of so many lines across it covers."""


def test_lines_of_a_path_that_lie_close_together_leave_the_map_to_be_seen(
    browser: Browser, page: ViewerPage
) -> None:
    browser.open(page.address)
    browser.wait("window.aquaflowTimes")
    two, dense = (browser.run(COVERED, lines) for lines in (2, 50))
    assert two == pytest.approx(2 * 1.0 / 200, rel=0.5)  # half of each line's 2 px lies inside
    assert 0.05 < dense < 0.25
