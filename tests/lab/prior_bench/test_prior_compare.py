"""``aquaflow lab prior compare``: the same pairs for every method, and figures that hold."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from aquaflow import cli
from aquaflow.base.errors import AquaFlowError, ConfigError, InputError
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.evaluation.matching import HEIGHT, WIDTH
from aquaflow.lab.prior_bench import comparison
from aquaflow.lab.prior_bench import comparison as clip_pairs
from aquaflow.lab.prior_bench import comparison as known_pairs
from aquaflow.lab.prior_bench.comparison import DenseMethod, SparseMethod, compare, methods_here
from aquaflow.lab.prior_bench.latency import sea_floor
from aquaflow.lab.prior_bench.pair import FoundMatches, KnownPair
from aquaflow.lab.prior_bench.table import figures_of
from aquaflow.lab.training.pair_generator.cameras import WIDE
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.prior.flow import pixel_grid
from aquaflow.prior.keypoint_networks.keypoint_prior import KeypointPrior
from aquaflow.sources import open_recording
from aquaflow.types import Frame
from tests.prior.keypoint_networks.corner_network import CornerNetwork

CAMERA = CameraModel(WIDTH, HEIGHT, 240.0, 240.0, 160.0, 120.0)
BLANK = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
GRID = pixel_grid(HEIGHT, WIDTH)
ROW = {
    "pairs", "count", "method", "judged_by", "matches", "recall", "precision", "median_px",
    "rotation_deg", "direction_deg", "picture_cpu_ms", "pair_cpu_ms",
}  # fmt: skip


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_pairs, "SIDES", (96, 72))
    monkeypatch.setattr(known_pairs, "GENERATED", {"generated, wide": WIDE})


def shifted(visible: float = 1.0) -> KnownPair:
    """Everything moves by 10 px; b shows the leftmost share of it."""
    shown = np.zeros((HEIGHT, WIDTH), bool)
    shown[:, : round(visible * WIDTH)] = True
    return KnownPair("shifted", BLANK, BLANK, CAMERA, CAMERA, GRID + np.float32([10, 0]), shown)


def dense(by: float, keep: float = 1.0) -> FoundMatches:
    here = GRID[: round(keep * HEIGHT)].reshape(-1, 2)
    there = here + np.float32([by, 0.0])
    return FoundMatches(here, there, np.ones((HEIGHT, WIDTH), bool))


def test_right_matches_have_full_recall_and_no_error() -> None:
    found = figures_of(shifted(), dense(10.0))
    assert (found.recall, found.precision) == (1.0, 1.0)
    assert found.median_px < 1e-4
    assert found.matches == WIDTH * HEIGHT
    assert found.rotation_deg is None


def test_matches_beyond_two_pixels_are_wrong() -> None:
    found = figures_of(shifted(), dense(12.1))
    assert (found.recall, found.precision) == (0.0, 0.0)
    assert abs(found.median_px - 2.1) < 1e-3


def test_half_of_the_matches_is_half_of_the_recall() -> None:
    assert figures_of(shifted(), dense(10.0, keep=0.5)).recall == 0.5


def test_a_match_of_what_the_second_picture_does_not_show_is_wrong() -> None:
    found = figures_of(shifted(visible=0.5), dense(10.0))
    assert found.recall == 1.0
    assert abs(found.precision - 0.5) < 0.01


def test_sparse_matches_between_pixels_have_no_recall() -> None:
    here = np.array([[20.3, 30.7], [100.9, 50.1]], np.float32)
    found = figures_of(shifted(), FoundMatches(here, here + np.float32([10.5, 0.0])))
    assert found.recall is None
    assert abs(found.median_px - 0.5) < 1e-4


def test_without_matches_nothing_is_known() -> None:
    none = np.zeros((0, 2), np.float32)
    found = figures_of(shifted(), FoundMatches(none, none))
    assert (found.matches, found.precision) == (0, 0.0)
    assert math.isnan(found.median_px)


def moving(truth: bool) -> tuple[KnownPair, FoundMatches]:
    """Points of a rough floor, seen from two places."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform(30.0, (WIDTH - 30.0, HEIGHT - 30.0), (400, 2))
    points = CAMERA.unproject(pixels) * rng.uniform(2.0, 4.0, (400, 1))
    T_ba = Sim3(cv2.Rodrigues(np.array([0.02, -0.03, 0.05]))[0], np.array([-0.4, 0.1, 0.05]))
    there = CAMERA.project(points @ T_ba.R.T + T_ba.t)
    known = (GRID, np.ones((HEIGHT, WIDTH), bool)) if truth else (None, None)
    pair = KnownPair("moving", BLANK, BLANK, CAMERA, CAMERA, *known, T_ba)
    return pair, FoundMatches(pixels.astype(np.float32), there.astype(np.float32))


def test_matches_of_a_clip_are_judged_by_their_epipolar_lines_and_the_pose() -> None:
    pair, found = moving(truth=False)
    assert pair.judged_by == "line"
    figures = figures_of(pair, found)
    assert figures.precision == 1.0
    assert figures.median_px < 1e-3
    assert figures.recall is None
    assert figures.rotation_deg is not None
    assert figures.rotation_deg < 0.05
    assert figures.direction_deg is not None
    assert figures.direction_deg < 0.5


def test_a_pose_that_does_not_follow_is_infinitely_wrong() -> None:
    pair, found = moving(truth=False)
    few = FoundMatches(found.pixels_a[:10], found.pixels_b[:10])
    assert figures_of(pair, few).rotation_deg == math.inf


@pytest.mark.usefixtures("small")
def test_generated_pairs_are_true_to_their_pictures(tmp_path: Path) -> None:
    """What flow matches well must lie where the truth says: a wrong truth would be seen."""
    pairs = known_pairs.generated_pairs(tmp_path, 3)
    assert [pair.group for pair in pairs] == 3 * ["generated, wide"]
    assert pairs[0].a.shape == (72, 96, 3)
    matched = DenseMethod("classical", ClassicalPrior())
    best = 0.0
    for pair in pairs:
        described = [
            matched.describe(picture, camera)
            for picture, camera in ((pair.a, pair.camera_a), (pair.b, pair.camera_b))
        ]
        best = max(best, figures_of(pair, matched.match(*described)).precision)
    assert best > 0.6
    again = known_pairs.generated_pairs(tmp_path, 3)
    assert all((one.b == other.b).all() for one, other in zip(pairs, again, strict=True))


def test_warped_pairs_are_found_by_every_kind_of_method() -> None:
    pairs = known_pairs.warped_pairs([sea_floor(640, 480)], 1)
    assert [pair.group for pair in pairs] == ["warped, mild", "warped, medium", "warped, hard"]
    network = CornerNetwork()
    usable = [
        DenseMethod("classical", ClassicalPrior()),
        SparseMethod("corners", network),
        DenseMethod("corners, then flow", KeypointPrior(network)),
    ]
    result = compare(comparison.Methods(usable, []), pairs[:1], lambda *_: None)
    assert [row["method"] for row in result["rows"]] == [method.name for method in usable]
    for row in result["rows"]:
        assert set(row) == ROW
        assert row["precision"] > 0.5
        assert (row["recall"] is None) == (row["method"] == "corners")


def test_networks_that_are_not_installed_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def lacking(kind: str, device: str) -> None:
        raise AquaFlowError(f"prior {kind} needs something")

    monkeypatch.setattr(comparison, "keypoint_network", lacking)
    found = methods_here("cpu")
    assert found.usable[0].name == "classical"
    assert found.missing[-2:] == [
        "XFeat: prior xfeat needs something",
        "ALIKED + LightGlue: prior aliked needs something",
    ]


@pytest.fixture
def clip(small_recording: Path, tmp_path: Path) -> Path:
    """A folder of pictures with camera.yaml and poses_sfm.tum."""
    folder = tmp_path / "clip"
    folder.mkdir()
    for picture in sorted((small_recording / "images").glob("*.png"))[:10]:
        shutil.copy(picture, folder)
    shutil.copy(small_recording / "camera.yaml", folder)
    return folder


def write_poses(clip: Path, dive: Path) -> None:
    """The true poses at the times that the folder's pictures have."""
    recording = open_recording(clip)
    times = [frame.t_ns * 1e-9 for frame in recording.frames() if isinstance(frame, Frame)]
    recording.close()
    lines = (dive / "poses.tum").read_text().splitlines()
    true = [line.split()[1:] for line in lines if not line.startswith("#")]
    rows = (f"{t:.9f} {' '.join(pose)}" for t, pose in zip(times, true[: len(times)], strict=True))
    (clip / clip_pairs.TRUTH).write_text("\n".join(rows))


def test_pairs_of_a_clip_have_its_true_poses(clip: Path, small_recording: Path) -> None:
    write_poses(clip, small_recording)
    pairs = clip_pairs.clip_pairs(clip, 2)
    assert len(pairs) == 2 + 2 + 2  # ten poses: none is 16 from another
    assert len({pair.group for pair in pairs}) == 3
    classical = DenseMethod("classical", ClassicalPrior())
    near = pairs[0]
    described = [classical.describe(picture, near.camera_a) for picture in (near.a, near.b)]
    figures = figures_of(near, classical.match(*described))
    assert figures.precision > 0.95
    assert figures.median_px < 0.3


def test_a_clip_without_poses_is_an_error(clip: Path) -> None:
    with pytest.raises(InputError, match=r"has no poses_sfm\.tum; give the folder"):
        clip_pairs.clip_pairs(clip, 2)


def test_a_folder_without_a_clip_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no poses_sfm\.tum and camera\.yaml"):
        clip_pairs.clip_pairs(tmp_path / "nowhere", 2)


@pytest.mark.usefixtures("small")
def test_the_command_compares_on_all_kinds_of_pairs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    classical = DenseMethod("classical", ClassicalPrior())
    here = comparison.Methods([classical], ["XFeat: it is not installed"])
    monkeypatch.setattr(comparison, "methods_here", lambda device: here)
    cv2.imwrite(str(tmp_path / "floor.png"), sea_floor(320, 240))
    options = ["--pairs", "1", "--pool", str(tmp_path / "pool"), "--pictures", str(tmp_path)]
    ran = CliRunner().invoke(cli.app, ["lab", "prior", "compare", *options, "--json"])
    assert ran.exit_code == 0, ran.output
    said = json.loads(ran.stdout)
    assert {row["pairs"] for row in said["rows"]} == {
        "generated, wide", "warped, mild", "warped, medium", "warped, hard",
    }  # fmt: skip
    assert {row["method"] for row in said["rows"]} == {"classical"}
    assert said["missing"] == here.missing
    shown = CliRunner().invoke(cli.app, ["lab", "prior", "compare", *options])
    assert "generated, wide (1)" in shown.stdout
    assert "XFeat: it is not installed" in shown.stdout
    assert "Times are of the processor." in shown.stdout


def test_a_device_that_has_no_such_name_is_refused_in_a_sentence() -> None:
    with pytest.raises(ConfigError, match=r"command line: .*device"):
        methods_here("é")
