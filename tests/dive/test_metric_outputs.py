"""One finished dive written twice: in its own unit, and in a frame n that is known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aquaflow
from aquaflow.base.storage.dive_status import DiveState, DiveStatus
from aquaflow.config import Config, load_config
from aquaflow.dive.deliverables import DeliverablePhase, Deliverables, deliverables_of
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.metric_outputs import (
    MetricOutputs,
    Navigation,
    sub_maps_in_words,
    utc_numbers,
    worlds_in_words,
)
from aquaflow.dive.ply import read_ply
from aquaflow.dive.trajectory_csv import read_trajectory_csv
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.evaluation.trajectory_error import read_tum
from aquaflow.slam import Slam
from aquaflow.sources import open_recording
from aquaflow.sources.preprocessing import Preparation
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.types import Frame, UtcTime
from aquaflow.water.daylight import Depths
from aquaflow.water.white_balance import WhiteBalance
from tests.metric_scenes import SCALE, SHIFT, TURN, metric_frame

SETTINGS = load_config(Path(__file__).parents[1] / "hasty.yaml")
FRAMES = 12
S = 1_000_000_000
NUMBERS = {"stage_ms": {}, "warnings": []}


@pytest.fixture(scope="module")
def slam(small_recording: Path) -> Slam:
    """A dive whose frames have all been mapped, before anything of it is written."""
    settings = SETTINGS.model_dump()
    settings["threads"], settings["source"]["width"] = 1, 96
    settings["mapping"]["optimiser"]["heldout_steps"] = 0  # poses that no evaluation moves
    config = Config.model_validate(settings)
    recording = open_recording(small_recording)
    prepare = Preparation(config.source, recording.camera)
    slam = Slam(config)
    for frame in recording.frames(stop=FRAMES):
        assert isinstance(frame, Frame)
        slam.process(prepare(frame))
    slam.finish()
    return slam


def written(slam: Slam, path: Path, outputs: MetricOutputs | None) -> Path:
    folder = DiveFolder(path, slam.config)
    others = deliverables_of(slam)
    made = Deliverables("dive", folder, slam, slam.results(), None, outputs, others=others)
    made.summarise()
    made.write()
    made.make(DeliverablePhase.WRITE)
    made.evaluate()
    made.write_evaluation()
    made.make(DeliverablePhase.REPORT, metrics=NUMBERS)
    folder.write_json("metrics.json", NUMBERS)
    folder.close()
    DiveStatus(DiveState.FINISHED).write(path)
    return path


@pytest.fixture(scope="module")
def plain(slam: Slam, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(slam, tmp_path_factory.mktemp("plain") / "dive", None)


@pytest.fixture(scope="module")
def metric(slam: Slam, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(
        slam, tmp_path_factory.mktemp("metric") / "dive", MetricOutputs({0: metric_frame()})
    )


def test_without_telemetry_every_file_is_as_the_map_has_it(
    slam: Slam, plain: Path, tmp_path: Path
) -> None:
    assert slam.metric_frames().keys() == {0}
    again = written(slam, tmp_path / "dive", MetricOutputs(slam.metric_frames()))
    for name in ("trajectory.tum", "trajectory.csv", "map.ply", "map_clear.ply", "medium.json"):
        assert (again / name).read_bytes() == (plain / name).read_bytes()
    first = (plain / "trajectory.tum").read_text().splitlines()[0]
    assert first == (
        "# camera to world; world is the first keyframe's camera (x right, y down, z forward); "
        "scale: see scale_source in metrics.json"
    )
    medium = json.loads((plain / "medium.json").read_text())
    assert medium["scale_source"] == "none: the median depth of the first keyframe is 1 map unit"
    assert "unit" not in medium
    assert not (plain / "georeference.json").exists()


def test_poses_are_turned_scaled_and_shifted(plain: Path, metric: Path) -> None:
    before, after = read_tum(plain / "trajectory.tum"), read_tum(metric / "trajectory.tum")
    assert len(after) == FRAMES
    moved = SCALE * before.positions @ TURN.T + SHIFT
    np.testing.assert_allclose(after.positions, moved, atol=1e-8)
    np.testing.assert_allclose(after.R_wc, TURN @ before.R_wc, atol=1e-8)
    first = (metric / "trajectory.tum").read_text().splitlines()[0]
    assert "x to true north" in first
    assert first.endswith("z down from the water surface; unit: m")


def test_gaussians_are_turned_scaled_and_shifted(plain: Path, metric: Path) -> None:
    for name in ("map.ply", "map_clear.ply"):
        before, after = read_ply(plain / name), read_ply(metric / name)
        moved = SCALE * before.means.astype(float) @ TURN.T + SHIFT
        np.testing.assert_allclose(after.means, moved, atol=1e-5)
        np.testing.assert_allclose(after.scales, SCALE * before.scales, rtol=1e-5)
        turned = TURN @ rotations(before.wxyz)
        np.testing.assert_allclose(rotations(after.wxyz), turned, atol=1e-5)
        np.testing.assert_array_equal(after.colours, before.colours)
    assert b"f_rest" not in (metric / "map.ply").read_bytes()[:2000]  # nothing that turns with it


def rotations(wxyz: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(wxyz, scalar_first=True).as_matrix()


def test_water_and_ranges_are_in_metres(plain: Path, metric: Path) -> None:
    before = json.loads((plain / "medium.json").read_text())
    after = json.loads((metric / "medium.json").read_text())
    assert (after["unit"], after["attenuation_unit"]) == ("m", "1/m")
    assert after["scale_source"] == "bar30, compass"
    for old, new in (
        (before["attenuation_per_unit"], after["attenuation_per_unit"]),
        (before["backscatter"]["b"], after["backscatter"]["b"]),
        (before["backscatter"]["d"], after["backscatter"]["d"]),
    ):
        np.testing.assert_allclose(np.multiply(new, SCALE), old, rtol=1e-6)
    for name in ("range_p5", "range_p95", "map_ply_reference_range"):
        assert after[name] == pytest.approx(SCALE * before[name], rel=1e-6)
    assert after["backscatter"]["B_inf"] == before["backscatter"]["B_inf"]
    (file,) = sorted((plain / "heldout").glob("*_range.npz"))
    z = np.load(file)["z"]
    in_metres = np.load(metric / "heldout" / file.name)["z"]
    assert in_metres.dtype == np.float32
    np.testing.assert_allclose(in_metres, SCALE * z, rtol=1e-6)


def test_the_same_light_arrives_through_the_same_water(plain: Path, metric: Path) -> None:
    """Transmission over a held-out view: rates and ranges change together."""
    seen = []
    for folder in (plain, metric):
        medium = json.loads((folder / "medium.json").read_text())
        (file,) = sorted((folder / "heldout").glob("*_range.npz"))
        z = np.load(file)["z"].astype(float)
        seen.append(np.exp(-z[..., None] * medium["attenuation_per_unit"]))
    np.testing.assert_allclose(seen[0], seen[1], atol=1e-6)


def test_the_table_agrees_with_the_trajectory_and_has_places(metric: Path) -> None:
    rows, trajectory = (
        read_trajectory_csv(metric / "trajectory.csv"),
        read_tum(metric / "trajectory.tum"),
    )
    np.testing.assert_allclose(
        [(row.x, row.y, row.z) for row in rows], trajectory.positions, atol=1e-6
    )
    assert all(row.latitude_deg is not None and row.heading_deg is not None for row in rows)
    stated = json.loads((metric / "georeference.json").read_text())
    assert stated["utm"]["epsg"] == 32632
    np.testing.assert_allclose(stated["sub_maps"]["0"]["T_nm"], metric_frame().T_nm.matrix)


def test_the_report_has_metres_with_their_sigma_and_every_source(metric: Path) -> None:
    page = (metric / "report.html").read_text()
    for text in (
        "metres, \u00b1 0.4 %",
        "to true north, \u00b1 0.57 degrees",
        "depth of the camera",
        "From above, true north up",
        "depth, m",
        "<td>bar30</td><td>depth</td>",
        "magnetic &lt;disturbance&gt;",
        "63.430000, 10.390000 (WGS 84)",
        "distance from the camera (m)",
    ):
        assert text in page, text
    assert "map units" not in page


def test_the_map_read_again_shows_the_same_in_metres(plain: Path, metric: Path) -> None:
    ours, theirs = aquaflow.load_map(plain), aquaflow.load_map(metric)
    assert (ours.unit, theirs.unit) == ("map units", "m")
    i = len(ours.views) // 2
    seen = ours.render(ours.views[i].T_wc)
    in_metres = theirs.render(theirs.views[i].T_wc)
    np.testing.assert_allclose(in_metres.image, seen.image, atol=2e-4)
    solid = seen.alpha > 0.9
    np.testing.assert_allclose(in_metres.range[solid], SCALE * seen.range[solid], rtol=1e-3)
    medium = theirs.medium
    assert medium is not None
    assert ours.medium is not None
    np.testing.assert_allclose(np.multiply(medium.beta_a, SCALE), ours.medium.beta_a, rtol=1e-5)
    np.testing.assert_allclose(
        theirs.gaussians.means, SCALE * ours.gaussians.means @ TURN.T + SHIFT, atol=1e-5
    )


def test_sub_maps_without_a_common_scale_are_called_so_only_if_that_is_true() -> None:
    known, unknown = metric_frame(), WorldFrame.unknown()
    assert sub_maps_in_words([known, unknown]) == "2 sub-maps without a common scale"
    assert "all in metres and level" in sub_maps_in_words([known, known])
    assert "how they lie to one another is not known" in sub_maps_in_words(
        [known, metric_frame(level=False)]
    )


def test_worlds_that_differ_are_named_for_each_sub_map() -> None:
    lines = worlds_in_words({0: metric_frame(), 3: WorldFrame.unknown()}).splitlines()
    assert [line.split(":")[0] for line in lines] == [
        "camera to world; sub-map 0", "camera to world; sub-map 3",
    ]  # fmt: skip
    assert lines[1].endswith("unit: map units")


def test_a_pose_of_a_sub_map_that_no_frame_is_known_for_stays(slam: Slam, tmp_path: Path) -> None:
    folder = DiveFolder(tmp_path / "dive", slam.config)
    made = Deliverables("d", folder, slam, slam.results(), None, MetricOutputs({9: metric_frame()}))
    folder.close()
    first = slam.results()[0].T_wc
    assert isinstance(first, Sim3)
    assert made.poses[0] is first or np.array_equal(made.poses[0].t, first.t)


def test_daylight_in_the_settings_is_of_the_dives_depth_and_missed_where_none_is_known(
    slam: Slam, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapper = slam.mappers[0]
    medium = mapper.config.medium.model_copy(update={"white_balance": "daylight:oceanic_II"})
    config = mapper.config.model_copy(update={"medium": medium})
    monkeypatch.setattr(mapper, "config", config)
    monkeypatch.setattr(mapper.scene, "balance", WhiteBalance(1.0, (0.4,) * 3, (1.0,) * 3, 0.1))
    monkeypatch.setattr(mapper, "tone", None)
    monkeypatch.setattr(mapper, "depths", None)

    def summarised(outputs: MetricOutputs) -> tuple[str, list[str]]:
        folder = DiveFolder(tmp_path / f"dive_{outputs.navigation.depth_m_at(0)}", slam.config)
        made = Deliverables("d", folder, slam, slam.results(), None, outputs)
        made.summarise()
        folder.close()
        assert mapper.scene.balance is not None
        return mapper.scene.balance.chosen.name, made.notes

    name, notes = summarised(MetricOutputs())
    assert name == "camera"
    assert "no depth below the surface is known" in notes[0]
    deep = Navigation(depth_m_at=lambda _: 12.0)
    assert summarised(MetricOutputs(navigation=deep)) == ("daylight:oceanic_II", [])
    assert mapper.depths == Depths(12.0, 0.0)


def test_numbers_say_when_the_dive_began_if_a_clock_was_heard() -> None:
    telemetry = Telemetry()
    assert utc_numbers(Navigation.of(telemetry))["utc_start"] is None
    for t_s in range(10):
        telemetry.add(UtcTime(t_s * S, t_s * S, "gps/RMC", (1_800_000_000 + t_s) * S))
    numbers = utc_numbers(Navigation.of(telemetry))
    assert numbers["utc_source"] == "gps/RMC"
    assert numbers["utc_start"].startswith("2027-01-15T0")
    assert numbers["utc_start"].endswith("Z")
    assert 0.0 < numbers["utc_sigma_s"] < 1.0
    json.dumps(numbers, allow_nan=False)
