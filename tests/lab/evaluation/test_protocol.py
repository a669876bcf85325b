"""``evaluate_dive`` on small dives written here, and its sentences for bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import InputError
from aquaflow.dive.tum import write_tum
from aquaflow.lab.evaluation.protocol import evaluate_dive
from aquaflow.lab.evaluation.trajectory_error import read_tum
from aquaflow.lab.synthetic.water import WATER_TYPES, save_medium

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"

COUNT = 12
SCALE = 0.25
"""Map units per metre of the dives written here."""

RNG = np.random.default_rng(0)
T_S = np.arange(COUNT) / 10.0
POSITIONS = RNG.normal(size=(COUNT, 3)).cumsum(0)
WXYZ = Rotation.random(COUNT, random_state=0).as_quat(scalar_first=True)
TURN = Rotation.random(random_state=1)
WATER = WATER_TYPES["oceanic_II"]


def write_dive(folder: Path, sub_maps=(0,) * COUNT, lost=(), positions=POSITIONS) -> Path:
    """A dive whose map is the truth, turned and scaled; lost frames have a row and no pose."""
    folder.mkdir(exist_ok=True)
    posed = np.array([i for i in range(COUNT) if i not in lost])
    wxyz = (TURN * Rotation.from_quat(WXYZ, scalar_first=True)).as_quat(scalar_first=True)
    write_tum(
        folder / "trajectory.tum",
        T_S[posed],
        SCALE * TURN.apply(positions)[posed],
        wxyz[posed],
    )
    rows = ["index,source,t_s,class,sub_map,quality,reason"]
    for i in range(COUNT):
        kind, sub_map = ("lost", "") if i in lost else ("common", sub_maps[i])
        rows.append(f"{i},{i + 1}.tif,{T_S[i]:.6f},{kind},{sub_map},0.9,")
    (folder / "frames.csv").write_text("\n".join(rows) + "\n")
    return folder


def write_truth(folder: Path) -> Path:
    folder.mkdir()
    write_tum(folder / "poses.tum", T_S, POSITIONS, WXYZ)
    save_medium(WATER, folder / "medium.yaml")
    return folder


def write_medium(dive: Path, unit: str = "1/map unit", **changes: object) -> None:
    per_unit = 1.0 / SCALE if unit == "1/map unit" else 1.0
    data = {
        "active": True,
        "attenuation_unit": unit,
        "attenuation_per_unit": [value * per_unit for value in WATER.beta_a],
        "backscatter": {
            "B_inf": WATER.B_inf,
            "b": [value * per_unit for value in WATER.b],
            "B_res": WATER.B_res,
            "d": [value * per_unit for value in WATER.d],
        },
    }
    (dive / "medium.json").write_text(json.dumps({**data, **changes}))


def test_perfect_dive_in_another_frame_and_scale_has_no_similarity_error(tmp_path):
    result = evaluate_dive(write_dive(tmp_path / "d"), write_truth(tmp_path / "t")).to_json()

    assert (result["frames"], result["posed"], result["posed_fraction"]) == (COUNT, COUNT, 1.0)
    assert result["ate_rmse_m_sim3"] < 1e-6
    assert result["ate_rmse_m_se3"] > 0.1
    assert result["alignment"]["scale"] == pytest.approx(1.0 / SCALE)
    assert result["rpe"]["pairs"] == COUNT - 1
    assert result["drift_pct"] < 1e-4
    assert result["path_length"] == pytest.approx(
        np.linalg.norm(np.diff(POSITIONS, axis=0), axis=1).sum()
    )
    assert result["medium_error"] is None
    assert result["notes"] == []
    json.dumps(result, allow_nan=False)


def test_pictures_metrics_are_copied_from_the_run(tmp_path):
    dive = write_dive(tmp_path / "d")
    (dive / "metrics.json").write_text('{"psnr": 24.5, "ssim": 0.8, "lpips": null, "fps": 3}')

    result = evaluate_dive(dive, write_truth(tmp_path / "t")).to_json()

    assert (result["psnr"], result["ssim"], result["lpips"]) == (24.5, 0.8, None)


def test_only_the_largest_sub_map_is_compared_and_the_rest_is_counted(tmp_path):
    broken = POSITIONS.copy()
    broken[8:] += 100.0
    dive = write_dive(tmp_path / "d", sub_maps=[0] * 7 + [0] + [1] * 4, lost=(3,), positions=broken)

    result = evaluate_dive(dive, write_truth(tmp_path / "t")).to_json()

    assert result["ate_rmse_m_sim3"] < 1e-6
    assert (result["posed"], result["matched"], result["left_out"]) == (11, 7, 4)
    assert (result["sub_map"], result["sub_maps"]) == (0, 2)
    assert "4 of 11 poses" in result["notes"][0]


def test_path_length_includes_true_poses_between_the_common_ones(tmp_path):
    truth = write_truth(tmp_path / "t")
    full = read_tum(truth / "poses.tum")
    dive = write_dive(tmp_path / "d", lost=(1, 3, 5, 7))

    result = evaluate_dive(dive, truth).to_json()

    assert result["path_length"] == pytest.approx(full.path_length)


@pytest.mark.parametrize("unit", ["1/map unit", "1/m"])
def test_true_water_in_map_units_or_metres_has_no_medium_error(tmp_path, unit):
    dive = write_dive(tmp_path / "d")
    write_medium(dive, unit)

    error = evaluate_dive(dive, write_truth(tmp_path / "t")).to_json()["medium_error"]

    assert error["attenuation_ratio"] == pytest.approx([1.0, 1.0, 1.0], rel=1e-6)
    assert error["backscatter_rmse"] < 1e-6
    assert error["active"] is True


def test_water_that_was_switched_off_recovers_nothing(tmp_path):
    dive = write_dive(tmp_path / "d")
    write_medium(dive, active=False)

    error = evaluate_dive(dive, write_truth(tmp_path / "t")).to_json()["medium_error"]

    assert error["attenuation_ratio"] == [0.0, 0.0, 0.0]
    assert error["active"] is False


def test_true_attenuation_of_zero_gives_no_ratio(tmp_path):
    dive, truth = write_dive(tmp_path / "d"), write_truth(tmp_path / "t")
    write_medium(dive)
    save_medium(WATER_TYPES["clear"], truth / "medium.yaml")

    error = evaluate_dive(dive, truth).to_json()["medium_error"]

    assert error["attenuation_ratio"] == [None, None, None]


def test_positions_of_named_pictures_are_a_truth(tmp_path):
    flat = POSITIONS * [1.0, 1.0, 0.0]
    dive = write_dive(tmp_path / "d", positions=flat)
    table = tmp_path / "positions.csv"
    rows = [f"{i + 1}.tif,{5e5 + p[0]:.6f},{5e6 + p[1]:.6f},0.1" for i, p in enumerate(flat)]
    table.write_text("\n".join(["file,easting_m,northing_m,extra", *rows[2:]]) + "\n")

    result = evaluate_dive(dive, table).to_json()

    assert result["matched"] == COUNT - 2
    assert result["ate_rmse_m_sim3"] < 1e-5
    assert result["rpe"] is None
    assert result["drift_pct"] is None
    assert "horizontal positions only" in result["notes"][0]


def test_folder_with_one_tum_file_is_a_truth(tmp_path):
    truth = write_truth(tmp_path / "t")
    (truth / "poses.tum").rename(truth / "poses_sfm.tum")

    assert evaluate_dive(write_dive(tmp_path / "d"), truth).error.matched == COUNT


def test_straight_dive_is_noted(tmp_path):
    line = np.outer(T_S, [1.0, 1.0, 0.0])
    truth = write_truth(tmp_path / "t")
    write_tum(truth / "poses.tum", T_S, line, WXYZ)

    result = evaluate_dive(write_dive(tmp_path / "d", positions=line), truth).to_json()

    assert result["rotation_rmse_deg"] is None
    assert "straight line" in result["notes"][0]


def spoil(path: Path, text: str | None) -> None:
    path.unlink() if text is None else path.write_text(text)


HEAD = "index,source,t_s,class,sub_map,quality,reason\n"
FILE_HEAD = "file,easting_m,northing_m\n"


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("d/trajectory.tum", None, "cannot read the trajectory"),
        ("d/frames.csv", None, "cannot read the frames"),
        ("d/frames.csv", "index,source\n1,2\n", "has no column class, sub_map, t_s"),
        ("d/frames.csv", HEAD + "0,a,x,common,0,1,\n", "line 2: t_s and sub_map must be numbers"),
        ("d/frames.csv", HEAD + "0,a,0.0,common,0,1,\n", "11 of 12 poses .* have no row"),
        ("d/metrics.json", "{", "cannot read .*metrics.json"),
        ("d/metrics.json", "[]", "metrics.json: it is no JSON object"),
        ("d/medium.json", "{}", "cannot read the medium .*key 'active' is missing"),
        ("d/medium.json", "x", "cannot read .*medium.json"),
        ("t/poses.tum", None, "holds 0 TUM files and no poses.tum"),
        ("t/poses.tum", "99 0 0 0 0 0 0 1\n", "no pose of .* covers 99 to 99 s"),
        ("t/poses.tum", "0 0 0 0 0 0 0 1\n", "at least 3 frames"),
    ],
)
def test_bad_dive_or_truth_is_one_sentence(tmp_path, name, text, sentence):
    write_dive(tmp_path / "d")
    write_truth(tmp_path / "t")
    spoil(tmp_path / name, text)

    with pytest.raises(InputError, match=sentence) as caught:
        evaluate_dive(tmp_path / "d", tmp_path / "t")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("file,x\n", "has no column easting_m, northing_m"),
        (FILE_HEAD, "holds no position"),
        (FILE_HEAD + "1.tif,a,2\n", "line 2: easting_m and northing_m must be numbers"),
        (FILE_HEAD + "1.tif,1\n", "line 2: easting_m and northing_m must be numbers"),
        (FILE_HEAD + "1.tif,nan,2\n", "line 2: a position is not finite"),
        (FILE_HEAD + "z.tif,1,2\n", "no picture named in"),
        ("file,\xff\n", "has no column"),
    ],
)
def test_bad_table_of_positions_is_one_sentence(tmp_path, text, sentence):
    table = tmp_path / "p.csv"
    table.write_text(text)

    with pytest.raises(InputError, match=sentence):
        evaluate_dive(write_dive(tmp_path / "d"), table)


def test_backscatter_that_is_no_colour_is_one_sentence(tmp_path):
    dive = write_dive(tmp_path / "d")
    write_medium(dive, attenuation_per_unit=[0.1, -1.0, 0.2])

    with pytest.raises(InputError, match="is not three numbers of at least 0"):
        evaluate_dive(dive, write_truth(tmp_path / "t"))


def test_missing_folders_are_one_sentence(tmp_path):
    with pytest.raises(InputError, match="there is no dive folder"):
        evaluate_dive(tmp_path / "none", tmp_path)
    with pytest.raises(InputError, match="there is no ground truth"):
        evaluate_dive(write_dive(tmp_path / "d"), tmp_path / "none")


@pytest.mark.skipif(not DATA.is_dir(), reason=f"the real data are not at {DATA}")
@pytest.mark.parametrize("clip", ["reef_clip", "curasao", "iui3_redsea"])
def test_real_truth_compared_with_itself_has_no_error(tmp_path, clip):
    truth = read_tum(DATA / clip / "poses_sfm.tum")
    write_tum(tmp_path / "trajectory.tum", truth.t_s, truth.positions, truth.wxyz)
    rows = [f"{i},f,{t:.9f},common,0,1," for i, t in enumerate(truth.t_s)]
    (tmp_path / "frames.csv").write_text(HEAD + "\n".join(rows))

    result = evaluate_dive(tmp_path, DATA / clip / "poses_sfm.tum").to_json()

    assert result["matched"] == len(truth)
    assert result["ate_pct_sim3"] < 1e-6
    assert result["rpe"]["rotation_rmse_deg"] < 1e-4
