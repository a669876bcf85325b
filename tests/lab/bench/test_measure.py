"""What the benchmark reads of a run: its pace, and the depth of its map."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from aquaflow.base.stages import pace
from aquaflow.base.storage.atomic import write_yaml
from aquaflow.config import Config
from aquaflow.lab.bench.runner import KEYS
from aquaflow.lab.bench.scene import BenchmarkScene
from aquaflow.lab.bench.summary import COLUMNS, attenuation_error_pct
from aquaflow.lab.bench.table import markdown
from aquaflow.lab.bench.worker import COLOURS, RESTORED, depth_error, measure_errors
from aquaflow.render.image_metrics import PSNR_LIMIT_DB

RUN = {"scene": "a", "preset": "fast", "peer": None, "repeat": 0, "failed": None}


def test_the_pace_counts_the_whole_run_and_single_frames() -> None:
    found = pace([10.0, 20.0, 30.0], 3, 0.5, 0.9)
    assert found["ms_per_frame"]["p50"] == 20.0
    assert found["ms_per_frame"]["total"] == 300.0
    assert found["time_to_first_pose_s"] == 0.5
    assert pace([10.0], 1, None, 1.0)["time_to_first_pose_s"] is None
    assert pace([], 2, 0.5, 1.0)["ms_per_frame"] == {"p50": None, "p95": None, "total": 500.0}


def test_the_depth_error_is_relative_and_over_what_both_know(tmp_path: Path) -> None:
    dive, truth = tmp_path / "dive", tmp_path / "truth"
    (dive / "heldout").mkdir(parents=True)
    (truth / "range").mkdir(parents=True)
    true, hit = np.full((4, 6), 2.0, np.float32), np.ones((4, 6), bool)
    hit[0] = False
    np.savez(truth / "range" / "000008.npz", range_m=true, hit=hit)
    z = np.full((2, 3), 1.1, np.float32)  # half the width
    z[1, 0] = 0.0
    np.savez(dive / "heldout" / "000008_range.npz", z=z)
    found = depth_error(dive, truth, metres_per_unit=2.0)
    assert found is not None
    assert np.isclose(found, 0.1)
    assert depth_error(tmp_path / "other", truth, 2.0) is None


def test_the_colours_of_what_is_nearest_need_no_truth(tmp_path: Path) -> None:
    scene, folder = BenchmarkScene("a", "a"), tmp_path / "heldout"
    assert {measure_errors(scene, tmp_path)[key] for key in COLOURS} == {None}
    folder.mkdir()
    for kind, bgr in (("real", (120, 130, 60)), ("restored", (60, 130, 120))):
        cv2.imwrite(str(folder / f"000008_{kind}.png"), np.full((4, 6, 3), bgr, np.uint8))
    np.savez(folder / "000008_range.npz", z=np.ones((4, 6), np.float32))
    row = measure_errors(scene, tmp_path)
    assert row["hue_shift_deg"] > 45.0
    assert markdown([{**dict.fromkeys(KEYS), **RUN, **row}]).count(f"{row['hue_shift_deg']:.1f}")


def test_restored_views_stand_next_to_what_published_methods_make_of_them(tmp_path: Path) -> None:
    dive, clean = tmp_path / "dive", tmp_path / "clean"
    (dive / "heldout").mkdir(parents=True)
    clean.mkdir()
    write_yaml(dive / "config.yaml", Config.model_validate({}).model_dump(mode="json"))
    picture = np.random.default_rng(0).integers(60, 200, (48, 64, 3), np.uint8)
    for path in (
        clean / "0.png",
        dive / "heldout" / "000000_real.png",
        dive / "heldout" / "000000_restored.png",
    ):
        assert cv2.imwrite(str(path), picture)
    row = measure_errors(BenchmarkScene("tiles", "/tiles", clean=str(clean)), dive)
    assert set(RESTORED) <= set(row)
    assert row["restored_psnr"] == row["raw_psnr"] == PSNR_LIMIT_DB
    assert list(row["restored_peer_reasons"]) == ["sea_thru"]
    by_title = {column.title: column for column in COLUMNS}
    for title, key in (("raw dB", "raw_psnr"), ("UDCP dB", "restored_psnr_udcp")):
        assert by_title[title].value(row) == row[key]
        assert row[key] is not None
    assert by_title["Sea-thru dB"].value(row) is None


def test_the_error_of_the_water_is_a_mean_over_known_channels() -> None:
    assert attenuation_error_pct({"medium_error": None}) is None
    row = {"medium_error": {"attenuation_ratio": [1.1, 0.8, None]}}
    found = attenuation_error_pct(row)
    assert found is not None
    assert np.isclose(found, 15.0)
