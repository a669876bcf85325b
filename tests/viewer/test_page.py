"""The viewer: a finished dive, a live one, browsers that hang, and one that is real."""

from __future__ import annotations

import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from aquaflow.config.viewer import ViewerConfig
from aquaflow.errors import InputError
from aquaflow.fusion.metric_file import write_metric_file
from aquaflow.geometry.camera import guess_camera
from aquaflow.geometry.similarity import Sim3
from aquaflow.viewer.finished import read_dive, show_dive
from aquaflow.viewer.page import ViewerPage
from aquaflow.viewer.splats import splats
from tests.metric_scenes import metric_frame
from tests.small_recording import HEIGHT, WIDTH

pytest.importorskip("viser", reason="viser is not installed")

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


@pytest.fixture
def page() -> Iterator[ViewerPage]:
    page = ViewerPage(ViewerConfig(port=0), "test")
    yield page
    page.close()


def many(count: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "means": rng.normal(size=(count, 3)).astype(np.float32),
        "quats": rng.normal(size=(count, 4)).astype(np.float32),
        "scales": np.full((count, 3), 0.05, np.float32),
        "opacities": np.full(count, 0.9, np.float32),
    }


def test_a_browser_that_never_reads_does_not_hold_up_who_shows(page: ViewerPage) -> None:
    port = int(page.address.rstrip("/").rpartition(":")[2])
    hung = socket.create_connection(("127.0.0.1", port), timeout=20)
    hung.sendall(UPGRADE)
    parts, camera = many(20_000), guess_camera(WIDTH, HEIGHT)
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for turn in range(20):  # 20 x 640 kB: far beyond what a socket's buffers take
        colours = {"water": np.full((20_000, 3), turn / 20, np.float32)}
        page.show_splats(splats(**parts, colours=colours, budget=20_000))
        page.show_camera(Sim3.identity(), camera, picture)
        page.show_path(parts["means"][: turn + 2], np.ones(turn + 2))
        page.show_health(f"turn {turn}")
    assert page.splats_shown == 20_000
    hung.close()


def test_a_finished_dive_is_read_with_its_colours_poses_and_pictures(small_dive: Path) -> None:
    dive = read_dive(small_dive, budget=500)
    assert len(dive.splats) == 500
    assert {"water", "clear"} == set(dive.splats.colours)
    assert len(dive.poses) == len(dive.quality) == len(dive.pictures)
    kept = [picture for picture in dive.pictures if picture is not None]
    assert len(kept) == len(list((small_dive / "heldout").glob("*_real.png")))


def test_a_metric_dive_says_its_unit_and_has_its_z_axis_down(
    small_dive: Path, tmp_path: Path
) -> None:
    dive = tmp_path / "dive"
    shutil.copytree(small_dive, dive)
    (dive / "metric.json").unlink()
    assert "map units" in read_dive(dive, budget=50).summary
    write_metric_file(dive, {0: metric_frame()}, main=0)
    shown = read_dive(dive, budget=50)
    assert "metres, \u00b1 0.4 %; x points to true north, z down" in shown.summary
    assert shown.level


def test_a_damaged_line_of_the_frames_costs_itself(small_dive: Path, tmp_path: Path) -> None:
    dive = tmp_path / "dive"
    shutil.copytree(small_dive, dive)
    header, *lines = (dive / "frames.csv").read_text().splitlines()
    lines[5] = lines[5].replace("0.", "0g.")
    (dive / "frames.csv").write_text("\n".join([header, "x", ",1e999,,,", *lines]))
    damaged, whole = read_dive(dive, budget=50), read_dive(small_dive, budget=50)
    assert len(damaged.poses) == len(whole.poses)
    assert (damaged.quality != whole.quality).sum() <= 1


@pytest.mark.parametrize(
    "line", ["1 2 3", "0 0 0 0 0 0 0 0", "0 nan 0 0 0 0 0 1", "0 x 0 0 0 0 0 1"]
)
def test_a_trajectory_that_holds_no_poses_is_refused(
    small_dive: Path, tmp_path: Path, line: str
) -> None:
    dive = tmp_path / "dive"
    shutil.copytree(small_dive, dive)
    (dive / "trajectory.tum").write_text(f"{line}\n")
    with pytest.raises(InputError, match=r"trajectory\.tum"):
        read_dive(dive, budget=50)


def test_a_folder_without_a_dive_is_refused_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"map\.ply is missing"):
        read_dive(tmp_path, budget=500)


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
def test_a_real_browser_shows_splats(small_dive: Path, tmp_path: Path) -> None:
    import cv2

    page = show_dive(read_dive(small_dive, budget=20_000), ViewerConfig(port=0))
    try:
        picture = screenshot(page.address, tmp_path / "shot.png")
    finally:
        page.close()
    scene = cv2.cvtColor(picture[:, : picture.shape[1] * 2 // 3], cv2.COLOR_BGR2HSV)
    coloured = (scene[..., 1] > 60).mean()
    assert coloured > 0.05, f"{100 * coloured:.1f} % of the page is coloured"


def screenshot(address: str, file: Path) -> np.ndarray:
    """[H, W, 3] BGR of the page in a headless Chromium."""
    import cv2

    assert BROWSER is not None
    software = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    quiet = ["--headless=new", "--no-sandbox", f"--user-data-dir={file.parent / 'profile'}"]
    waiting = ["--virtual-time-budget=30000", "--timeout=90000", "--window-size=1280,800"]
    subprocess.run(
        [BROWSER, *quiet, *software, *waiting, f"--screenshot={file}", address],
        capture_output=True,
        timeout=300,
        check=True,
    )
    picture = cv2.imread(str(file))
    assert picture is not None
    return np.asarray(picture)
