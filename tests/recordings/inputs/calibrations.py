"""Calibrations of other programs, each of the lens through which the pictures were drawn."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from aquaflow.geometry.camera import CameraModel
from tests.recordings.inputs import Dive, Made, Picture, made, row, write_plainly
from tests.recordings.inputs.bags import Messages, pictures_of, write_bag

RADTAN, FISHEYE = (-0.25, 0.06, 0.002, -0.001), (0.05, -0.02, 0.004, 0.001)
"""Coefficients of OpenCV's two models: a wide lens."""


def _through(dive: Dive, camera: CameraModel) -> list[Picture]:
    """The dive as the lens draws it."""
    height, width = dive.pictures[0].shape[:2]
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([columns, rows], axis=2).reshape(-1, 1, 2)
    K, D = camera.K, np.array(camera.distortion)
    undistort = cv2.fisheye.undistortPoints if camera.distortion_model == "fisheye" else (
        cv2.undistortPoints
    )  # fmt: skip
    rays = undistort(pixels, K, D).reshape(height, width, 2)
    plain = dive.camera
    x = (rays[..., 0] * plain.fx + plain.cx - 0.5).astype(np.float32)
    y = (rays[..., 1] * plain.fy + plain.cy - 0.5).astype(np.float32)
    return [
        np.asarray(cv2.remap(each, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))
        for each in dive.pictures
    ]


Write = Callable[[CameraModel], str]


def _matrix(c: CameraModel) -> str:
    return f"[{c.fx}, 0, {c.cx - 0.5}, 0, {c.fy}, {c.cy - 0.5}, 0, 0, 1]"


def _ros(model: str) -> Write:
    return lambda c: (
        f"image_width: {c.width}\nimage_height: {c.height}\ncamera_name: cam\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {_matrix(c)}}}\ndistortion_model: {model}\n"
        "distortion_coefficients: "
        f"{{rows: 1, cols: {len(c.distortion)}, data: {list(c.distortion)}}}\n"
    )


def _opencv(c: CameraModel) -> str:
    d = f"rows: 1\n   cols: {len(c.distortion)}\n   dt: d\n   data: {list(c.distortion)}\n"
    fisheye = "fisheye_model: 1\n" if c.distortion_model == "fisheye" else ""
    return (
        f"%YAML:1.0\n---\nimage_width: {c.width}\nimage_height: {c.height}\n{fisheye}"
        f"camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: {_matrix(c)}\n"
        f"distortion_coefficients: !!opencv-matrix\n   {d}"
    )


def _opencv_xml(c: CameraModel) -> str:
    d = " ".join(map(str, c.distortion))
    k = _matrix(c).strip("[]").replace(",", "")
    return (
        f'<?xml version="1.0"?><opencv_storage><image_width>{c.width}</image_width>'
        f"<image_height>{c.height}</image_height>"
        f'<Camera_Matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>'
        f'<data>{k}</data></Camera_Matrix><Distortion_Coefficients type_id="opencv-matrix">'
        f"<rows>1</rows><cols>4</cols><dt>d</dt><data>{d}</data></Distortion_Coefficients>"
        "</opencv_storage>"
    )


def _kalibr(model: str) -> Write:
    return lambda c: (
        f"cam0:\n  camera_model: pinhole\n  intrinsics: [{c.fx}, {c.fy}, {c.cx - 0.5}, "
        f"{c.cy - 0.5}]\n  distortion_model: {model}\n  distortion_coeffs: {list(c.distortion)}\n"
        f"  resolution: [{c.width}, {c.height}]\n  rostopic: /cam0/image_raw\n"
    )


def _colmap(model: str, *more: float) -> Write:
    return lambda c: (
        "# Camera list with one line of data per camera:\n"
        f"1 {model} {c.width} {c.height} {c.fx} {c.fy} {c.cx} {c.cy} "
        + " ".join(map(str, (*c.distortion, *more)))
    )


def _metashape(c: CameraModel) -> str:
    k1, k2, p1, p2 = c.distortion
    return (
        '<?xml version="1.0"?>\n<calibration><projection>frame</projection>'
        f"<width>{c.width}</width><height>{c.height}</height><f>{c.fy}</f>"
        f"<cx>{c.cx - c.width / 2}</cx><cy>{c.cy - c.height / 2}</cy><b1>{c.fx - c.fy}</b1>"
        f"<k1>{k1}</k1><k2>{k2}</k2><p1>{p2}</p1><p2>{p1}</p2></calibration>"
    )


def _odm(kind: str) -> Write:
    def write(c: CameraModel) -> str:
        side = max(c.width, c.height)
        names = ("k1", "k2", "p1", "p2") if kind == "brown" else ("k1", "k2", "k3", "k4")
        lens = {
            "projection_type": kind, "width": c.width, "height": c.height, "focal_x": c.fx / side,
            "focal_y": c.fy / side, "c_x": (c.cx - c.width / 2) / side,
            "c_y": (c.cy - c.height / 2) / side, **dict(zip(names, c.distortion, strict=True)),
        }  # fmt: skip
        return json.dumps({"v2 gopro hero 4000 3000 brown 0.5": lens})

    return write


FORMATS: list[tuple[str, str, Write]] = [
    ("ROS", "ost.yaml", _ros("plumb_bob")),
    ("OpenCV YAML", "opencv.yml", _opencv),
    ("OpenCV XML", "opencv.xml", _opencv_xml),
    ("Kalibr", "camchain.yaml", _kalibr("radtan")),
    ("COLMAP OPENCV", "cameras.txt", _colmap("OPENCV")),
    ("COLMAP FULL_OPENCV", "cameras.txt", _colmap("FULL_OPENCV", 0.0, 0.0, 0.0, 0.0)),
    ("Metashape", "camera.xml", _metashape),
    ("OpenDroneMap", "cameras.json", _odm("brown")),
    ("ROS equidistant", "ost.yaml", _ros("equidistant")),
    ("ROS kannala_brandt", "ost.yaml", _ros("kannala_brandt")),
    ("OpenCV fisheye", "opencv.yml", _opencv),
    ("Kalibr equidistant", "camchain.yaml", _kalibr("equidistant")),
    ("COLMAP OPENCV_FISHEYE", "cameras.txt", _colmap("OPENCV_FISHEYE")),
    ("OpenDroneMap fisheye", "cameras.json", _odm("fisheye_opencv")),
]


def lens_of(dive: Dive, name: str) -> CameraModel:
    """The lens of a row, with the principal point off the middle."""
    wide = any(part in name.lower() for part in ("fisheye", "equidistant", "kannala"))
    moved = replace(dive.camera, fx=140.0, fy=143.0, cx=82.0, cy=59.0)
    if wide:
        return replace(moved, distortion_model="fisheye", distortion=FISHEYE)
    return replace(moved, distortion_model="radtan", distortion=RADTAN)


def _format(name: str, file: str, write: Write) -> None:
    @row(f"calibration {name}", near=0.0)
    def _made(dive: Dive, folder: Path) -> Made:
        camera = lens_of(dive, name)
        pictures = _through(dive, camera)
        (folder / file).write_text(write(camera))
        read = made(dive, folder / "p", pictures=pictures, camera=camera)
        write_plainly(folder / "p", read, camera)
        (folder / "p" / "camera.yaml").unlink()
        return replace(read, calibration=folder / file)


for _each in FORMATS:
    _format(*_each)


@row("calibration beside the pictures", near=0.0, says="the calibration is ")
def _beside(dive: Dive, folder: Path) -> Made:
    camera = lens_of(dive, "ours")
    read = made(dive, folder / "p", pictures=_through(dive, camera), camera=camera)
    write_plainly(folder / "p", read, camera)
    return read


@row("bag CameraInfo equidistant", near=0.0, says="K and D")
def _info_equidistant(dive: Dive, folder: Path) -> Made:
    camera, messages = lens_of(dive, "fisheye"), Messages(ros1=False)
    seen = replace(dive, pictures=_through(dive, camera))
    info = messages.camera_info(camera, model="equidistant", d=camera.distortion)
    events = [("/cam/camera_info", 0, info), *pictures_of(messages, seen)]
    path = write_bag(folder / "bag", messages, events)
    return made(dive, path, pictures=seen.pictures, camera=camera)


def _refused(name: str, file: str, text: Write, words: str) -> None:
    @row(f"calibration {name}", refuses=words)
    def _made(dive: Dive, folder: Path) -> Made:
        read = made(dive, folder / "p", camera=dive.camera)
        write_plainly(folder / "p", read, dive.camera)
        (folder / file).write_text(text(dive.camera))
        return replace(read, calibration=folder / file)


_refused(
    "ROS of a model that is not known", "ost.yaml", _ros("mei"),
    "as a calibration of ROS, key 'distortion_model' is 'mei', which is not known",
)  # fmt: skip
_refused(
    "Kalibr without resolution", "camchain.yaml",
    lambda c: _kalibr("radtan")(c).replace("resolution", "size"),
    "as a calibration of Kalibr, key 'resolution' is missing",
)  # fmt: skip
_refused(
    "COLMAP with a number missing", "cameras.txt", _colmap("OPENCV", 1.0, 2.0, 3.0),
    "as a calibration of COLMAP, OPENCV has 7 numbers instead of: fx fy cx cy k1 k2 p1 p2",
)  # fmt: skip
_refused(
    "Metashape cut off", "camera.xml", lambda c: "<calibration><width>160</wid",
    "as a calibration of Metashape or OpenCV, it is damaged XML",
)  # fmt: skip
_refused(
    "OpenDroneMap spherical", "cameras.json",
    lambda c: json.dumps({"a": {"projection_type": "spherical", "width": 9, "height": 9}}),
    "as a calibration of OpenDroneMap, key 'projection_type' is 'spherical'",
)  # fmt: skip
_refused(
    "of another shape", "camera.yaml", lambda c: _ours(replace(c, width=320, height=120, cx=160.0)),
    "the calibration is for 320 x 120 pictures, these are 160 x 120",
)  # fmt: skip


def _ours(camera: CameraModel) -> str:
    names = ("width", "height", "fx", "fy", "cx", "cy")
    return "\n".join(f"{name}: {getattr(camera, name)}" for name in names)
