"""Cameras: projection and its inverse, resized and cropped pictures, and ``camera.yaml``."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from aquaflow.base.errors import ConfigError, InputError
from aquaflow.geometry.camera import (
    GUESSED_FOCAL_WIDTHS,
    CameraModel,
    camera_of_values,
    guess_camera,
    has_unmeasured_port,
    load_camera,
    save_camera,
)
from aquaflow.geometry.port import FRESH_WATER, SEA_WATER, DomePort, FlatPort, Port, water_index

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
CALIBRATIONS = sorted(SHARED.glob("*/camera.yaml"))

CAMERA = CameraModel(640, 480, 500.0, 510.0, 315.0, 242.0)

VALID = {"width": 640, "height": 480, "fx": 500.0, "fy": 510.0, "cx": 315.0, "cy": 242.0}


def written(folder: Path, **changes: object) -> Path:
    path = folder / "camera.yaml"
    path.write_text(yaml.safe_dump({**VALID, **changes}))
    return path


@given(st.floats(-50, 700), st.floats(-50, 500), st.floats(0.01, 1e4))
def test_projecting_undoes_unprojecting_at_any_depth(u: float, v: float, depth: float) -> None:
    pixel = np.array([u, v])
    ray = CAMERA.unproject(pixel)
    assert ray[2] == 1.0
    np.testing.assert_allclose(CAMERA.project(depth * ray), pixel, atol=1e-9 * (1 + abs(u)))


def test_projection_is_the_intrinsic_matrix() -> None:
    point = np.array([0.3, -0.2, 2.0])
    expected = CAMERA.K @ point
    np.testing.assert_allclose(CAMERA.project(point), expected[:2] / expected[2])


def test_points_in_or_behind_the_camera_project_to_finite_pixels() -> None:
    points = np.array([[1.0, 1.0, 0.0], [0.1, 0.2, -3.0], [0.0, 0.0, 0.0]])
    assert np.isfinite(CAMERA.project(points)).all()


def test_the_top_left_pixel_has_its_centre_at_a_half() -> None:
    centres = CAMERA.pixel_centres()
    assert centres.shape == (480, 640, 2)
    np.testing.assert_array_equal(centres[0, 0], [0.5, 0.5])
    np.testing.assert_array_equal(centres[7, 3], [3.5, 7.5])


@given(st.integers(8, 2000), st.integers(8, 2000))
def test_a_resized_camera_sees_every_point_at_the_resized_pixel(width: int, height: int) -> None:
    point = np.array([0.4, -0.3, 1.7])
    factor = np.array([width / CAMERA.width, height / CAMERA.height])
    resized = CAMERA.resize(width, height)
    assert (resized.width, resized.height) == (width, height)
    np.testing.assert_allclose(resized.project(point), CAMERA.project(point) * factor)


def test_a_cropped_camera_sees_every_point_moved_by_the_crop() -> None:
    point = np.array([0.4, -0.3, 1.7])
    cropped = CAMERA.crop(100, 60, 320, 240)
    assert (cropped.width, cropped.height) == (320, 240)
    np.testing.assert_allclose(cropped.project(point), CAMERA.project(point) - [100, 60])


def test_cropping_then_resizing_is_resizing_then_cropping() -> None:
    first = CAMERA.crop(100, 60, 320, 240).resize(160, 120)
    second = CAMERA.resize(320, 240).crop(50, 30, 160, 120)
    assert first == second


def test_scaling_the_focal_length_leaves_the_centre() -> None:
    longer = CAMERA.with_focal_scaled(1.5)
    assert (longer.fx, longer.fy) == (750.0, 765.0)
    assert (longer.cx, longer.cy) == (CAMERA.cx, CAMERA.cy)


def test_a_guessed_camera_says_that_it_is_a_guess() -> None:
    camera = guess_camera(800, 600)
    assert not camera.calibrated
    assert camera.fx == camera.fy == GUESSED_FOCAL_WIDTHS * 800
    assert (camera.cx, camera.cy) == (400.0, 300.0)
    assert not camera.is_distorted


@pytest.mark.parametrize(
    ("model", "coefficients", "distorted"),
    [
        ("none", (), False),
        ("none", (0.1,), False),
        ("radtan", (0.0, 0.0), False),
        ("radtan", (0.0, 0.1), True),
        ("fisheye", (0.1, 0.0, 0.0, 0.0), True),
        ("fisheye", (0.0, 0.0, 0.0, 0.0), True),
        ("fisheye", (), True),
    ],
)
def test_a_fisheye_and_coefficients_that_are_not_zero_distort(
    model: str, coefficients: tuple[float, ...], distorted: bool
) -> None:
    camera = CameraModel(
        64,
        48,
        50.0,
        50.0,
        32.0,
        24.0,
        distortion_model=model,  # type: ignore[arg-type]
        distortion=coefficients,
    )
    assert camera.is_distorted is distorted


# --- camera.yaml ----------------------------------------------------------------------------------


@pytest.mark.skipif(not CALIBRATIONS, reason=f"no shared clips under {SHARED}")
@pytest.mark.parametrize("path", CALIBRATIONS, ids=lambda path: path.parent.name)
def test_the_shared_calibrations_load(path: Path) -> None:
    data = yaml.safe_load(path.read_text())
    camera = load_camera(path)
    assert (camera.width, camera.height) == (data["width"], data["height"])
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == tuple(
        data[key] for key in ("fx", "fy", "cx", "cy")
    )
    assert camera.distortion == tuple(data.get("distortion", ()))
    assert camera.calibrated


@pytest.mark.parametrize(
    ("written_as", "read_as"),
    [
        ("none", "none"),
        ("radial", "radtan"),
        ("radtan", "radtan"),
        ("opencv", "radtan"),
        ("fisheye", "fisheye"),
    ],
)
def test_the_names_of_distortion_models_are_understood(
    tmp_path: Path, written_as: str, read_as: str
) -> None:
    path = written(tmp_path, distortion_model=written_as, distortion=[0.01, 0.0, 0.0, 0.0])
    assert load_camera(path).distortion_model == read_as


@pytest.mark.parametrize(
    "port",
    [
        None,
        FlatPort(0.05, 0.01, 1.5, 1.3391, (0.6 * 0.1, 0.8 * 0.1, float(np.sqrt(0.99))), 2.0),
        DomePort(0.05, 0.003, (1e-3, -2e-3, 1 / 300), 1.59, 1.3391, 0.7),
    ],
)
def test_a_saved_camera_loads_as_it_was(tmp_path: Path, port: Port | None) -> None:
    camera = CameraModel(
        640,
        480,
        500.0,
        510.0,
        315.0,
        242.0,
        distortion_model="fisheye",
        distortion=(0.1, -0.02, 0.0, 0.001),
        port=port,
    )
    save_camera(camera, tmp_path / "camera.yaml")
    assert load_camera(tmp_path / "camera.yaml") == camera


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"focal": 500.0}, "focal"),
        ({"fx": "wide"}, "fx"),
        ({"fx": 0.0}, "fx"),
        ({"fy": -3.0}, "fy"),
        ({"width": 0}, "width"),
        ({"height": -1}, "height"),
        ({"distortion": [0.1] * 15}, "distortion"),
        ({"distortion": [0.1, "x"]}, "distortion.1"),
        ({"distortion_model": "kannala"}, "distortion_model"),
        ({"port": "hemisphere"}, "port"),
        ({"model": "orthographic"}, "model"),
    ],
)
def test_a_wrong_key_or_value_is_named_with_its_file(
    tmp_path: Path, changes: dict[str, object], key: str
) -> None:
    path = written(tmp_path, **changes)
    with pytest.raises(ConfigError, match=rf"camera\.yaml: key '{key}'") as caught:
        load_camera(path)
    assert str(path) in str(caught.value)
    assert "known keys are" in str(caught.value)


def test_a_missing_key_is_named(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump({key: VALID[key] for key in VALID if key != "cy"}))
    with pytest.raises(ConfigError, match="key 'cy'"):
        load_camera(path)


def test_a_missing_file_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read the calibration"):
        load_camera(tmp_path / "nowhere.yaml")


def test_bytes_that_are_no_text_are_an_input_error(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_bytes(b"\xff\xfe\xff\xd8")
    with pytest.raises(InputError, match="cannot read the calibration"):
        load_camera(path)


def test_a_file_that_is_not_yaml_is_an_input_error(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text("fx: [1, 2\nfy: }")
    with pytest.raises(InputError, match="is not YAML"):
        load_camera(path)


def test_an_empty_file_lacks_its_first_key(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text("")
    with pytest.raises(ConfigError, match="key 'width': field required"):
        load_camera(path)


@pytest.mark.parametrize("text", ["- 1\n- 2\n", "just words\n"])
def test_a_file_without_keys_is_a_config_error(tmp_path: Path, text: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="holds no key: value pairs"):
        load_camera(path)


# --- the port -------------------------------------------------------------------------------------

FLAT = {"kind": "flat", "distance_m": 0.05, "thickness_m": 0.01}
DOME = {"kind": "dome", "radius_m": 0.05, "thickness_m": 0.003}


def test_a_flat_port_is_read_with_its_defaults(tmp_path: Path) -> None:
    assert load_camera(written(tmp_path, port=FLAT)).port == FlatPort(0.05, 0.01, 1.49, SEA_WATER)


@pytest.mark.parametrize(
    ("water", "index"),
    [
        ("fresh", FRESH_WATER),
        (1.337, 1.337),
        ({"salinity_psu": 7.0, "temperature_c": 15.0}, water_index(7.0, 15.0)),
        ({"depth_m": 3000.0}, water_index(depth_m=3000.0)),
    ],
)
def test_the_water_is_named_measured_or_given_as_its_index(
    tmp_path: Path, water: object, index: float
) -> None:
    port = load_camera(written(tmp_path, port=DOME | {"water": water, "glass": "glass"})).port
    assert port == DomePort(0.05, 0.003, glass=1.52, water=index)


def test_the_normal_of_a_port_is_made_a_unit_vector(tmp_path: Path) -> None:
    port = load_camera(written(tmp_path, port=FLAT | {"normal": [0.3, 0.0, 0.4]})).port
    assert isinstance(port, FlatPort)
    assert port.normal == pytest.approx((0.6, 0.0, 0.8))


@pytest.mark.parametrize("kind", ["flat", "dome"])
def test_a_port_without_measures_is_refused_in_one_sentence(tmp_path: Path, kind: str) -> None:
    with pytest.raises(ConfigError, match=f"key 'port': port: {kind} lacks its measures") as caught:
        load_camera(written(tmp_path, port=kind))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("port", "message"),
    [
        (FLAT | {"gap": 0.1}, r"key 'port.gap': .*known keys are .*distance_m"),
        (DOME | {"distance_m": 0.1}, r"key 'port.distance_m': .*known keys are .*radius_m"),
        ({"kind": "flat", "distance_m": 0.1}, r"key 'port.thickness_m': field required"),
        ({"distance_m": 0.1}, r"key 'port': it is none, or has kind"),
        (FLAT | {"distance_m": 50.0}, r"key 'port.distance_m'"),
        (FLAT | {"water": "beer"}, r"key 'port.water"),
        (FLAT | {"glass": 3.0}, r"key 'port.glass"),
        (FLAT | {"normal": [1.0, 0.0, 0.2]}, r"key 'port': the normal of the port must lie"),
        (FLAT | {"normal": [0.0, 0.0, 0.0]}, r"key 'port': the normal of the port must lie"),
        (FLAT | {"range_m": 0.05}, r"key 'port': range_m lies inside the housing"),
        (DOME | {"range_m": 0.05}, r"key 'port': range_m lies inside the housing"),
        (DOME | {"centre_m": [0.0, 0.06, 0.0]}, r"key 'port': centre_m is farther away"),
    ],
)
def test_a_wrong_measure_of_a_port_is_named(
    tmp_path: Path, port: dict[str, object], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        load_camera(written(tmp_path, port=port))


def old_form(kind: str) -> dict[str, object]:
    """What AquaFlow 0.1 wrote into recordings and checkpoints."""
    measures = {"thickness_m": 0.0, "distance_m": 0.0}
    indexes = {"refractive_index_glass": 1.49, "refractive_index_water": 1.34}
    return asdict(CAMERA) | {"port": {"kind": kind} | measures | indexes}


def test_a_camera_reads_back_from_json_with_every_bit() -> None:
    camera = replace(CAMERA, port=DomePort(0.05, 0.003, (1e-3, -2e-3, 1 / 300)), calibrated=False)
    assert camera_of_values(json.loads(json.dumps(asdict(camera)))) == camera


@pytest.mark.parametrize(("kind", "unmeasured"), [("none", False), ("flat", True), ("dome", True)])
def test_a_port_of_old_recordings_is_left_out_and_known_to_lack_its_measures(
    kind: str, unmeasured: bool
) -> None:
    assert camera_of_values(old_form(kind)) == CAMERA
    assert has_unmeasured_port(old_form(kind)) is unmeasured
