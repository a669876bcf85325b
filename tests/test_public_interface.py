"""``import aquaflow`` as a scientist uses it: a recording mapped, a dive and its map read."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import aquaflow
from aquaflow.api.map import Map
from aquaflow.dive.map_file import read_map_file
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.restoration import mean_water
from aquaflow.render import select_renderer
from aquaflow.water.mounting import Lamp
from tests.command_line import Cli
from tests.metric_scenes import metric_frame

HASTY = Path(__file__).with_name("hasty.yaml")


def test_every_public_name_is_there_and_listed() -> None:
    assert {name for name in aquaflow.__all__ if getattr(aquaflow, name, None) is None} == set()
    assert set(aquaflow.__all__) <= set(dir(aquaflow))


def test_a_name_that_is_not_public_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        _ = aquaflow.no_such_name


def test_reading_the_names_loads_no_heavy_library() -> None:
    heavy = ("torch", "cv2", "numpy")
    code = f"import aquaflow, sys; dir(aquaflow); print([m for m in {heavy} if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_a_recording_is_mapped_and_read_back(small_recording: Path, tmp_path: Path) -> None:
    stages = set()
    dive = aquaflow.map_recording(
        small_recording,
        tmp_path / "dive",
        config=HASTY,
        settings={"source": {"stop": 8}},
        progress=lambda stage, done, total: stages.add(stage),
    )
    assert dive.path == tmp_path / "dive"
    assert len(dive) == dive.metrics["frames"] == 8
    assert {"map", "refine"} <= stages


def test_a_wrong_setting_is_refused_before_anything_is_written(
    small_recording: Path, tmp_path: Path
) -> None:
    with pytest.raises(aquaflow.AquaFlowError, match="no_such"):
        aquaflow.map_recording(small_recording, tmp_path / "dive", settings={"no_such": 1})
    assert not (tmp_path / "dive").exists()


def test_a_dive_has_a_row_for_every_pose(small_dive: Path) -> None:
    dive = aquaflow.read_dive(small_dive)
    rows = [dive.frames[row] for row in dive.frame_of_pose]
    assert len(rows) == len(dive.trajectory) == dive.metrics["tracked"]
    np.testing.assert_allclose([row.t_s for row in rows], dive.trajectory.t_s, atol=1e-3)
    assert dive.sub_map_of_pose.tolist() == [row.sub_map for row in rows]
    assert dive.camera.width == 160
    assert dive.medium is not None


def test_a_dive_and_its_map_have_one_unit_and_its_table_has_every_pose(small_dive: Path) -> None:
    dive, scene = aquaflow.read_dive(small_dive), aquaflow.load_map(small_dive)
    assert dive.unit == scene.unit == dive.metric_frames[0].unit
    rows = dive.navigation()
    np.testing.assert_allclose([row.x for row in rows], dive.trajectory.positions[:, 0], atol=1e-6)
    assert {row.unit for row in rows} == {dive.unit}


def test_measures_are_those_of_the_command(small_dive: Path, command: Cli) -> None:
    dive = aquaflow.read_dive(small_dive)
    centres = np.asarray(aquaflow.load_map(small_dive).gaussians.means, float)
    points = [tuple(centre) for centre in np.round(centres[[0, 1]], 6).tolist()]
    given = [word for point in points for word in ("--point", ",".join(map(str, point)))]
    said = json.loads(command("measure", small_dive, *given, "--json").out)["measured"]
    found = aquaflow.measure(dive, points)
    assert set(found) == set(said)
    for name, quantity in found.items():
        assert quantity.value == pytest.approx(said[name]["value"])
        assert quantity.sigma == pytest.approx(said[name]["sigma"])
    numbers = json.loads((small_dive / "reef_numbers.json").read_text())["numbers"]
    ground = aquaflow.measure(small_dive)
    assert ground["surveyed_area"].value == pytest.approx(numbers["surveyed_area"]["value"])
    with pytest.raises(aquaflow.AquaFlowError, match="is no point"):
        aquaflow.measure(dive, ["here", "there"])


def test_exports_are_those_of_the_command(small_dive: Path, command: Cli, tmp_path: Path) -> None:
    asked = ("--format", "ply,laz", "--resolution", 0.3, "--water")
    ran = command("export", small_dive, *asked, "--out", tmp_path / "cli", "--json")
    stages = set()
    found = aquaflow.export(
        aquaflow.read_dive(small_dive),
        ["ply", "laz"],
        tmp_path / "api",
        resolution=0.3,
        water=True,
        progress=lambda stage, done, total: stages.add(stage),
    )
    said = json.loads(ran.out.replace(str(tmp_path / "cli"), str(tmp_path / "api")))
    assert found == said
    assert set(found) == {"laz", "ply"}
    assert "laz" in stages
    for name in ("mesh.ply", "points.laz"):
        assert (tmp_path / "api" / name).read_bytes() == (tmp_path / "cli" / name).read_bytes()
    with pytest.raises(aquaflow.AquaFlowError, match="'tiff' is no --format"):
        aquaflow.export(small_dive, "laz,tiff", tmp_path / "none")
    with pytest.raises(aquaflow.AquaFlowError, match="knows no --resolution"):
        aquaflow.export(small_dive, "laz", tmp_path / "none", resolution=0.3)
    assert not (tmp_path / "none").exists()


def test_a_folder_without_a_dive_is_refused_with_its_path(tmp_path: Path) -> None:
    def export(dive: Path) -> None:
        aquaflow.export(dive, "all")

    for read in (aquaflow.read_dive, aquaflow.load_map, aquaflow.measure, export):
        with pytest.raises(aquaflow.AquaFlowError, match=str(tmp_path)):
            read(tmp_path)


def test_a_map_shows_what_its_camera_saw(small_dive: Path) -> None:
    import cv2

    scene = aquaflow.load_map(str(small_dive))
    view = scene.views[len(scene.views) // 2]
    shown = scene.render(view.T_wc)
    picture = small_dive / "heldout" / "000008_real.png"
    assert shown.image.shape == cv2.imread(str(picture)).shape
    held_out = aquaflow.read_dive(small_dive)
    [pose] = [i for i, row in enumerate(held_out.frame_of_pose) if held_out.frames[row].index == 8]
    trajectory = held_out.trajectory
    T_wc = Sim3(trajectory.R_wc[pose], trajectory.positions[pose])
    seen = cv2.imread(str(picture))[..., ::-1] / 255.0
    error = np.abs(scene.render(T_wc, held_out.camera).image - seen).mean()
    elsewhere = np.abs(shown.image - seen).mean()
    assert error < 0.5 * elsewhere


def test_a_map_gives_its_gaussians_and_its_medium_as_arrays(small_dive: Path) -> None:
    scene = aquaflow.load_map(small_dive / "map.aqf")
    gaussians = scene.gaussians
    assert gaussians.means.shape == (len(scene), 3)
    np.testing.assert_allclose(np.linalg.norm(gaussians.wxyz, axis=1), 1.0, atol=1e-5)
    assert (gaussians.scales > 0).all()
    medium, written = scene.medium, aquaflow.read_dive(small_dive).medium
    assert medium is not None
    assert written is not None
    np.testing.assert_allclose(medium.beta_a, written.beta_a, rtol=1e-4)
    np.testing.assert_allclose(medium.b, written.b, rtol=1e-4)


def test_a_medium_has_the_lamps_light_in_its_unit_and_as_the_map_is_drawn(
    small_dive: Path, tmp_path: Path
) -> None:
    mapper = read_map_file(small_dive / "map.aqf", select_renderer("cpu"))
    mapper.scene.lamp = Lamp(share=0.7, power=2.05, range=1.5)
    water, metric = mean_water(mapper.scene, mapper.views), metric_frame()
    assert water is not None
    medium = Map(mapper, metric).medium
    assert medium is not None
    z = np.array([0.01, 0.5, 1.5, 4.0])
    drawn = water.transmission(torch.tensor(z))
    found = medium.transmission(metric.T_nm.scale * z)
    np.testing.assert_allclose(found, drawn.numpy(), rtol=1e-5)
    assert found[1, 2] > 1.0 > found[3, 2]
    assert (medium.transmission(np.array([np.inf])) == 0.0).all()


def test_a_dive_reads_its_lamp_and_refuses_a_damaged_one(small_dive: Path, tmp_path: Path) -> None:
    dive = shutil.copytree(small_dive, tmp_path / "dive")
    facts = json.loads((dive / "medium.json").read_text())
    lamp = {"share": 0.7, "power": 2.05, "range": 1.5}
    (dive / "medium.json").write_text(json.dumps(facts | {"lamp": lamp}))
    medium = aquaflow.read_dive(dive).medium
    assert medium is not None
    assert medium.lamp == Lamp(**lamp)
    for damage in ({"share": 2.0}, {"range": 0.0}, {"power": float("nan")}):
        (dive / "medium.json").write_text(json.dumps(facts | {"lamp": lamp | damage}))
        with pytest.raises(aquaflow.AquaFlowError, match="the lamp is no share"):
            _ = aquaflow.read_dive(dive).medium


def test_what_is_done_to_the_arrays_does_not_change_the_map(small_dive: Path) -> None:
    scene = aquaflow.load_map(small_dive)
    before = scene.gaussians.means.copy()
    scene.gaussians.means[:] = 0.0
    np.testing.assert_array_equal(scene.gaussians.means, before)
