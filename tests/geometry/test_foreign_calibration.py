"""Calibrations of other programs give the camera that those programs mean."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.base.errors import ConfigError
from aquaflow.geometry.camera import CameraModel, load_camera, save_for_others

D = (-0.3, 0.1, 0.001, -0.002, 0.02)

ROS = """
image_width: 640
image_height: 480
camera_name: cam
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 319.5, 0, 510, 239.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.3, 0.1, 0.001, -0.002, 0.02]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [450, 0, 3, 0, 0, 4, 5, 0, 0, 0, 1, 0]}
"""
KALIBR = """
cam0:
  camera_model: pinhole
  intrinsics: [500, 510, 319.5, 239.5]
  distortion_model: radtan
  distortion_coeffs: [-0.3, 0.1, 0.001, -0.002]
  resolution: [640, 480]
  rostopic: /cam0
"""
METASHAPE = """<?xml version="1.0"?>
<calibration><projection>frame</projection><width>640</width><height>480</height>
<f>510</f><cx>0</cx><cy>0</cy><b1>-10</b1><k1>-0.3</k1><k2>0.1</k2><k3>0.02</k3>
<p1>-0.002</p1><p2>0.001</p2></calibration>
"""
ODM = {
    "v2 gopro": {
        "projection_type": "brown", "width": 640, "height": 480, "focal_x": 500 / 640,
        "focal_y": 510 / 640, "c_x": 0.0, "c_y": 0.0, "k1": -0.3, "k2": 0.1, "p1": 0.001,
        "p2": -0.002, "k3": 0.02,
    }
}  # fmt: skip
ORB_SLAM = """%YAML:1.0
---
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: 500.0
Camera1.fy: 510.0
Camera1.cx: 319.5
Camera1.cy: 239.5
Camera1.k1: -0.3
Camera1.k2: 0.1
Camera1.p1: 0.001
Camera1.p2: -0.002
Camera1.k3: 0.02
Camera.width: 640
Camera.height: 480
ORBextractor.nFeatures: 1000
Tbc: !!opencv-matrix
   rows: 1
   cols: 1
   dt: f
   data: [1.0]
"""
VINS = """%YAML:1.0
---
model_type: PINHOLE
camera_name: camera
image_width: 640
image_height: 480
distortion_parameters:
   k1: -0.3
   k2: 0.1
   p1: 0.001
   p2: -0.002
projection_parameters:
   fx: 500
   fy: 510
   cx: 319.5
   cy: 239.5
"""
VINS_FISHEYE = """%YAML:1.0
---
model_type: KANNALA_BRANDT
camera_name: camera
image_width: 640
image_height: 480
projection_parameters:
   k2: -0.06
   k3: -0.004
   k4: 0.03
   k5: -0.03
   mu: 500
   mv: 510
   u0: 319.5
   v0: 239.5
"""
OKVIS = """%YAML:1.0
cameras:
     - {T_SC:
        [ 0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1],
        image_dimension: [640, 480],
        distortion_coefficients: [-0.3, 0.1, 0.001, -0.002],
        distortion_type: radialtangential,
        focal_length: [500, 510],
        principal_point: [319.5, 239.5]}
camera_params:
     camera_rate: 20
"""
EUROC = """
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
rate_hz: 20
resolution: [640, 480]
camera_model: pinhole
intrinsics: [500, 510, 319.5, 239.5] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.3, 0.1, 0.001, -0.002]
"""
FULL = "1 FULL_OPENCV 640 480 500 510 320 240 -0.3 0.1 0.001 -0.002 0.02 0 0 0"

FILES = {
    "ros.yaml": ROS,
    "kalibr.yaml": KALIBR,
    "metashape.xml": METASHAPE,
    "cameras.json": json.dumps(ODM),
    "cameras.txt": f"# Camera list\n{FULL}\n",
    "orb_slam.yaml": ORB_SLAM,
    "orb_slam2.yaml": ORB_SLAM.replace("Camera1.", "Camera.").replace('Camera.type: "PinHole"', ""),
    "vins.yaml": VINS,
    "okvis.yaml": OKVIS,
    "sensor.yaml": EUROC,
}
FOUR_NUMBERS = ("kalibr.yaml", "okvis.yaml", "sensor.yaml")
"""Files whose distortion has no k3."""


@pytest.mark.parametrize("name", FILES)
def test_the_camera_is_the_one_that_is_meant(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(FILES[name])
    camera = load_camera(tmp_path / name)
    assert (camera.width, camera.height) == (640, 480)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((500, 510, 320, 240))
    expected = {"vins.yaml": (*D[:4], 0.0)}.get(name, D[:4] if name in FOUR_NUMBERS else D)
    assert camera.distortion == pytest.approx(expected)


@pytest.mark.parametrize(
    "text",
    [
        VINS_FISHEYE,
        ORB_SLAM.replace("PinHole", "KannalaBrandt8")
        .replace("k1: -0.3", "k1: -0.06")
        .replace("k2: 0.1", "k2: -0.004")
        .replace("p1: 0.001", "k4: -0.03")
        .replace("k3: 0.02", "k3: 0.03"),
    ],
    ids=["VINS", "ORB-SLAM3"],
)
def test_fisheye_lenses_of_slam_systems_are_read(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.yaml").write_text(text)
    camera = load_camera(tmp_path / "c.yaml")
    assert camera.distortion_model == "fisheye"
    assert camera.distortion == pytest.approx((-0.06, -0.004, 0.03, -0.03))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((500, 510, 320, 240))


@pytest.mark.parametrize("centre", ["662.1, 0, 510, 239.5", "319.5, 0, 510, 482"])
def test_a_calibration_of_another_picture_size_is_refused(tmp_path: Path, centre: str) -> None:
    (tmp_path / "c.yaml").write_text(ROS.replace("319.5, 0, 510, 239.5", centre))
    with pytest.raises(ConfigError, match="lies outside of the picture of 640 x 480 pixels"):
        load_camera(tmp_path / "c.yaml")


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_opencvs_own_files_are_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"opencv{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array([[500.0, 0, 319.5], [0, 510, 239.5], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([D]))
    storage.release()
    camera = load_camera(path)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500, 510, 320, 240)
    assert camera.distortion == pytest.approx(D)


@pytest.mark.parametrize(
    ("line", "model", "distortion"),
    [
        ("1 SIMPLE_PINHOLE 640 480 500 320 240", "none", ()),
        ("1 PINHOLE 640 480 500 500 320 240", "none", ()),
        ("1 SIMPLE_RADIAL 640 480 500 320 240 0.1", "radtan", (0.1, 0, 0, 0, 0)),
        ("1 RADIAL 640 480 500 320 240 0.1 0.2", "radtan", (0.1, 0.2, 0, 0, 0)),
        ("1 OPENCV 640 480 500 500 320 240 1 2 3 4", "radtan", (1, 2, 3, 4, 0)),
        ("1 OPENCV_FISHEYE 640 480 500 500 320 240 1 2 3 4", "fisheye", (1, 2, 3, 4)),
    ],
)
def test_colmaps_models_are_used(
    tmp_path: Path, line: str, model: str, distortion: tuple[float, ...]
) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text(line)
    camera = load_camera(path)
    assert (camera.fx, camera.cx, camera.distortion_model) == (500, 320, model)
    assert camera.distortion == distortion


@pytest.mark.parametrize("name", ["equidistant", "kannala_brandt"])
def test_names_of_the_fisheye_model_are_used(tmp_path: Path, name: str) -> None:
    path = tmp_path / "ours.yaml"
    lens = "{width: 64, height: 48, fx: 50, fy: 50, cx: 32, cy: 24, "
    path.write_text(lens + f"distortion_model: {name}, distortion: [0.1, 0, 0, 0]}}")
    assert load_camera(path).distortion_model == "fisheye"
    (tmp_path / "ros.yaml").write_text(ROS.replace("plumb_bob", name).replace(", 0.02]", "]"))
    assert load_camera(tmp_path / "ros.yaml").distortion_model == "fisheye"


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("ros.yaml", ROS.replace("plumb_bob", "mei"), "ROS.*'distortion_model'.*mei"),
        ("k.yaml", KALIBR.replace(": pinhole", ": omni"), "Kalibr.*'camera_model'.*omni"),
        ("k.yaml", KALIBR.replace("resolution", "size"), "Kalibr.*'resolution' is missing"),
        ("cameras.txt", "1 FOV 640 480 1 2 3 4 5", "COLMAP.*'FOV'"),
        ("m.xml", METASHAPE.replace("frame", "fisheye"), "Metashape.*'fisheye'"),
        ("c.json", json.dumps({"a": {"projection_type": "dual"}}), "OpenDroneMap.*'dual'"),
        (
            "c.json",
            json.dumps({"a": ODM["v2 gopro"] | {"k1": "?"}}),
            "'k1' is '.', which is no num",
        ),
        ("c.json", json.dumps([ODM]), "OpenDroneMap, it holds no cameras; leave one"),
        ("c.json", "{", "OpenDroneMap, it is damaged JSON"),
        ("c.json", json.dumps({"a": 3}), "OpenDroneMap, it is no list of keys and values"),
        ("ros.yaml", ROS.replace("[500,", "[x,"), "ROS, key 'camera_matrix' is 'x', which is no n"),
        (
            "ros.yaml",
            ROS.replace(", 0, 0, 1]}", "]}", 1),
            "'camera_matrix' holds 6 numbers instead",
        ),
        (
            "ros.yaml",
            ROS.replace("camera_matrix: {rows: 3, cols: 3, data: ", "camera_matrix: 7 #"),
            "ROS, key 'camera_matrix' is '7', which is no list",
        ),
        ("k.yaml", KALIBR.replace("[500, 510, ", "["), "'intrinsics' holds 2 numbers instead of 4"),
        (
            "k.yaml",
            KALIBR + KALIBR.replace("cam0", "cam1"),
            "Kalibr, it holds 2 cameras; leave one",
        ),
        ("k.yaml", "cam0: 3", "Kalibr, it is no list of keys"),
        (
            "o.yaml",
            "camera_matrix: [1, 0, 1, 0, 1, 1, 0, 0, 1]",
            "OpenCV, key 'image_width' is miss",
        ),
        ("cameras.txt", "1 PINHOLE 640 480 5 5 3", "PINHOLE has 3 numbers instead of: fx fy cx cy"),
        ("cameras.txt", "1 PINHOLE 640 x 5 5 3 3", "COLMAP, key 'HEIGHT' is 'x', which is no numb"),
        ("cameras.txt", "words", "COLMAP, its line is short"),
        ("o.yaml", ORB_SLAM + "Camera2.fx: 500.0\n", "ORB-SLAM, it holds 2 cameras; leave Camera1"),
        ("o.yaml", ORB_SLAM.replace("Camera.width", "Width"), "'Camera.width' is missing"),
        ("v.yaml", VINS.replace("PINHOLE", "MEI"), "VINS, key 'model_type' is 'MEI'"),
        ("v.yaml", VINS_FISHEYE.replace("   mu", "   nu"), "VINS, key 'mu' is missing"),
        (
            "v.yaml",
            "{model_type: PINHOLE, image_width: 1, image_height: 1, distortion_parameters: 3}",
            "'distortion_parameters' is '3', which is no list of keys",
        ),
        ("s.yaml", OKVIS.replace("camera_params", "     - {}\ncamera_params"), "holds 2 cameras"),
        ("s.yaml", "cameras: [3]", "OKVIS, it is no list of keys"),
        ("m.xml", "<calibration>", "Metashape or OpenCV, it is damaged XML"),
        ("m.xml", METASHAPE.replace("<f>510</f>", ""), "Metashape or OpenCV, key 'f' is missing"),
    ],
)
def test_what_is_not_understood_is_named(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=words):
        load_camera(tmp_path / name)


@pytest.mark.parametrize(("model", "count"), [("radtan", 5), ("radtan", 8), ("fisheye", 4)])
def test_files_for_ros_and_opencv_hold_the_same_camera(
    tmp_path: Path, model: str, count: int
) -> None:
    kind = "fisheye" if model == "fisheye" else "radtan"
    numbers = tuple(0.01 * (n + 1) for n in range(count))
    camera = CameraModel(640, 480, 500.25, 510.5, 321.5, 239.0, kind, numbers)  # type: ignore[arg-type]
    ros, opencv = save_for_others(camera, tmp_path)
    assert load_camera(ros) == camera
    assert load_camera(opencv) == camera
    storage = cv2.FileStorage(str(opencv), cv2.FILE_STORAGE_READ)
    assert storage.getNode("camera_matrix").mat()[0, 2] == 321.0


def test_entities_that_grow_without_end_are_refused(tmp_path: Path) -> None:
    grow = "".join(f"<!ENTITY e{k + 1} '{f'&e{k};' * 10}'>" for k in range(9))
    bomb = f"<!DOCTYPE c [<!ENTITY e0 '{'x' * 100}'>{grow}]><calibration>&e9;</calibration>"
    (tmp_path / "m.xml").write_text(bomb)
    with pytest.raises(ConfigError, match="Metashape"):
        load_camera(tmp_path / "m.xml")
