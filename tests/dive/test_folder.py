"""The dive folder: every file of docs/formats.md#dive-folder, readable by what reads it."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.base.storage.dive_status import (
    DiveState,
    DiveStatus,
    read_status,
    unfinished_reason,
)
from aquaflow.config import Config, load_config
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.frames_csv import FrameRow
from aquaflow.dive.ply import read_ply
from aquaflow.geometry.camera import load_camera
from aquaflow.lab.evaluation.trajectory_error import read_tum
from tests.small_recording import FRAMES, HEIGHT, WIDTH

METRICS = {
    *("frames", "tracked", "lost", "skipped", "keyframes", "mapping_frames", "common_frames"),
    *("gaussians", "wall_s", "fps", "stage_ms", "peak_rss_mb", "psnr", "ssim", "flip"),
    *("lpips", "lpips_alex", "lpips_reason", "heldout_frames"),
    *("ate_rmse_m_se3", "ate_rmse_m_sim3", "rpe"),
    *("scale_source", "scale_sigma", "unit", "north", "gravity_sigma_deg", "telemetry"),
    *("utc_start", "utc_source", "utc_sigma_s"),
    *("renderer", "prior", "device", "seed", "version", "protocol"),
}
"""The keys that docs/formats.md#metrics-json promises."""

HELD_OUT = (8, 16)
DEFAULT = Config.model_validate({})


def table(dive: Path) -> list[dict[str, str]]:
    with (dive / "frames.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


@contextmanager
def opened(path: Path, overwrite: bool = False) -> Iterator[DiveFolder]:
    folder = DiveFolder(path, DEFAULT, overwrite)
    try:
        yield folder
    finally:
        folder.close()


def test_every_frame_is_in_the_table_once_and_in_order(small_dive: Path) -> None:
    rows = table(small_dive)
    assert [int(row["index"]) for row in rows] == list(range(FRAMES))
    assert [row["source"] for row in rows] == [f"{i:06d}.png" for i in range(FRAMES)]
    assert {row["class"] for row in rows} <= {"keyframe", "mapping", "common"}
    assert rows[0]["class"] == "keyframe"


def test_trajectory_has_the_posed_frames_at_their_times(small_dive: Path) -> None:
    posed = [float(row["t_s"]) for row in table(small_dive) if row["sub_map"]]
    trajectory = read_tum(small_dive / "trajectory.tum")
    np.testing.assert_allclose(trajectory.t_s, posed, atol=1e-9)
    np.testing.assert_allclose(posed, np.arange(FRAMES) / 10.0, atol=1e-9)


def test_metrics_have_the_stable_keys_and_agree_with_the_table(small_dive: Path) -> None:
    metrics = json.loads((small_dive / "metrics.json").read_text())
    assert metrics.keys() >= METRICS
    classes = [row["class"] for row in table(small_dive)]
    assert metrics["frames"] == metrics["tracked"] == FRAMES
    assert metrics["keyframes"] == classes.count("keyframe")
    assert metrics["mapping_frames"] == classes.count("mapping")
    assert metrics["common_frames"] == classes.count("common")
    assert metrics["heldout_frames"] == len(HELD_OUT)
    assert (metrics["flip"] is None) == (find_spec("flip_evaluator") is None)
    assert (metrics["unit"] == "m") == (metrics["scale_sigma"] is not None)
    assert (metrics["north"] == "first keyframe") == (metrics["gravity_sigma_deg"] is None)
    for stage in metrics["stage_ms"].values():
        assert stage.keys() == {"count", "total", "p50", "p95"}


def test_maps_load_and_differ_only_in_colour(small_dive: Path) -> None:
    seen, clear = (read_ply(small_dive / name) for name in ("map.ply", "map_clear.ply"))
    count = json.loads((small_dive / "metrics.json").read_text())["gaussians"]
    assert len(seen.means) == len(clear.means) == count > 0
    np.testing.assert_array_equal(seen.means, clear.means)
    assert np.abs(seen.colours - clear.colours).max() > 0.01


def test_water_has_its_rates_and_their_unit(small_dive: Path) -> None:
    medium = json.loads((small_dive / "medium.json").read_text())
    assert medium["active"]
    metric = medium.get("unit") == "m"
    assert medium["attenuation_unit"] == ("1/m" if metric else "1/map unit")
    values = [medium["attenuation_per_unit"], *medium["backscatter"].values()]
    assert np.shape(values) == (5, 3)
    assert np.min(values) >= 0.0
    assert medium["range_p5"] <= medium["map_ply_reference_range"] <= medium["range_p95"]


def test_no_channel_is_amplified_more_than_the_posterior_allows(small_dive: Path) -> None:
    medium = json.loads((small_dive / "medium.json").read_text())
    found = medium["restored"]["amplification"]
    applied, allowed = np.array(found["applied"]), np.array(found["allowed"])
    assert applied.shape == allowed.shape == (3,)
    assert (applied > 0.5).all()
    assert (applied <= allowed).all()


def test_config_cameras_log_and_report_can_be_read_again(small_dive: Path) -> None:
    assert load_config(small_dive / "config.yaml").mapping.optimiser.refine_steps == 60
    camera = load_camera(small_dive / "camera.yaml")
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert load_camera(small_dive / "calibration.yaml").fx == pytest.approx(camera.fx)
    for line in (small_dive / "log.jsonl").read_text().splitlines():
        assert {"t_s", "utc", "level", "message"} <= json.loads(line).keys()
    report = (small_dive / "report.html").read_text()
    assert report.startswith("<!doctype html>")
    assert "http://" not in report.replace("http://www.w3.org", "")


def test_held_out_pictures_lie_beside_what_the_map_shows(small_dive: Path) -> None:
    for index in HELD_OUT:
        for kind in ("real", "rendered", "restored"):
            picture = cv2.imread(str(small_dive / "heldout" / f"{index:06d}_{kind}.png"))
            assert picture.shape == (HEIGHT, WIDTH, 3)
        confidence = cv2.imread(
            str(small_dive / "heldout" / f"{index:06d}_confidence.png"), cv2.IMREAD_UNCHANGED
        )
        assert confidence.shape == (HEIGHT, WIDTH)
        assert 0 < confidence.mean() < 255
        assert (small_dive / "heldout" / f"{index:06d}_range.npz").exists()
    assert len(list((small_dive / "heldout").iterdir())) == 5 * len(HELD_OUT)


def test_what_was_decided_is_on_disk_before_the_end(tmp_path: Path) -> None:
    with opened(tmp_path / "dive") as folder:
        folder.record([FrameRow(3, "3.png", 0.3, "lost", reason="blurred, and dark")])
        (row,) = table(folder.path)
        assert (row["index"], row["class"], row["reason"]) == ("3", "lost", "blurred, and dark")


def test_table_is_sorted_at_the_end(tmp_path: Path) -> None:
    with opened(tmp_path / "dive") as folder:
        folder.record([FrameRow(i, f"{i}.png", i / 10.0, "common", 0, 0, 0.5) for i in (2, 0, 1)])
        folder.write_frames({})
        assert [row["index"] for row in table(folder.path)] == ["0", "1", "2"]


def test_a_frame_stands_in_the_sub_map_that_it_ended_up_in(tmp_path: Path) -> None:
    with opened(tmp_path / "dive") as folder:
        folder.record([FrameRow(i, f"{i}.png", i / 10.0, "common", i, 0, 0.5) for i in (0, 1)])
        folder.write_frames({1: 0})
        assert [row["sub_map"] for row in table(folder.path)] == ["0", "0"]


def test_a_number_that_is_not_finite_is_null_and_costs_no_other(tmp_path: Path) -> None:
    nan, inf = float("nan"), float("inf")
    with opened(tmp_path / "dive") as folder:
        folder.write_json("metrics.json", {"psnr": nan, "stages": {"a": [1.5, inf]}, "n": 3})
        written = json.loads((folder.path / "metrics.json").read_text())
    assert written == {"psnr": None, "stages": {"a": [1.5, None]}, "n": 3}


def finish(folder: DiveFolder) -> None:
    folder.write_json("metrics.json", {})
    folder.set_finished()


def test_a_replay_that_was_cut_off_or_came_to_nothing_begins_anew_in_its_folder(
    tmp_path: Path,
) -> None:
    dive = tmp_path / "dive"
    with opened(dive):
        (dive / "map.ply").touch()
    with opened(dive) as folder:
        assert not (dive / "map.ply").exists()
        folder.set_finished()  # nothing of it could be mapped
    with opened(dive) as folder:
        finish(folder)
    with pytest.raises(InputError, match="already holds a dive"):
        DiveFolder(dive, DEFAULT)


@pytest.mark.parametrize(
    "status",
    [DiveStatus(DiveState.OPEN, boot="1"), DiveStatus(DiveState.RESCALING), None],
    ids=["live", "rescaling", "unknown"],
)
def test_no_other_dive_is_replaced_unasked(tmp_path: Path, status: DiveStatus | None) -> None:
    with opened(tmp_path / "dive") as folder:
        dive = folder.path
    if status is None:
        (dive / "dive.json").unlink()
    else:
        status.write(dive)
    with pytest.raises(InputError, match="already holds a dive"):
        DiveFolder(dive, DEFAULT)


def test_overwriting_removes_results_and_keeps_what_is_not_a_runs(tmp_path: Path) -> None:
    dive = tmp_path / "dive"
    with opened(dive) as folder:
        (dive / "map_1.ply").touch()
        (dive / "my notes.txt").touch()
        finish(folder)
    with pytest.raises(InputError, match="--overwrite"):
        DiveFolder(dive, DEFAULT)
    with opened(dive, overwrite=True):
        assert not (dive / "map_1.ply").exists()
        assert (dive / "my notes.txt").exists()


def test_a_folder_is_open_before_anything_in_it_is_touched_and_finished_when_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dive, unlink = tmp_path / "dive", Path.unlink
    with opened(dive) as folder:
        assert "is being written" in (unfinished_reason(dive) or "")
        (dive / "map.ply").touch()
        (dive / "metrics.json").write_text("{}")
        folder.set_finished()
    assert unfinished_reason(dive) is None
    states = []

    def seen(self: Path, missing_ok: bool = False) -> None:
        if self.name == "map.ply":
            status = read_status(dive)
            states.append(None if status is None else status.state)
        unlink(self, missing_ok)

    monkeypatch.setattr(Path, "unlink", seen)
    with opened(dive, overwrite=True):
        pass
    assert states == [DiveState.OPEN]
    assert "mapping it was cut off, or failed" in (unfinished_reason(dive) or "")


def test_a_folder_that_was_cut_off_before_its_table_can_be_mapped_into_again(
    tmp_path: Path,
) -> None:
    (tmp_path / f".{32 * '0'}.part").touch()
    with opened(tmp_path):
        pass
    (tmp_path / "frames.csv").unlink()
    with opened(tmp_path, overwrite=True):
        assert (tmp_path / "frames.csv").exists()


def write(path: Path, content: bytes) -> None:
    with atomic_write(path) as stream:
        stream.write(content)


def test_deliverables_that_were_not_written_again_are_set_aside_until_they_are(
    tmp_path: Path,
) -> None:
    with opened(tmp_path / "dive") as folder:
        for name in ("map.ply", "report.html"):
            write(folder.path / name, b"old")
        before = folder.deliverables()
        write(folder.path / "report.html", b"new")
        folder.set_aside(before)
        assert not (folder.path / "map.ply").exists()
        assert (folder.path / "map.earlier.ply").read_bytes() == b"old"
        assert (folder.path / "report.html").read_bytes() == b"new"
        before = folder.deliverables()
        for name in ("map.ply", "report.html"):
            write(folder.path / name, b"newer")
        folder.set_aside(before)
        assert list(folder.path.glob("*.earlier.*")) == []
