"""Calibrations as other programs write them, as the values of ``camera.yaml``.

ROS (camera_info_manager), OpenCV's FileStorage, Kalibr's camchain, COLMAP's cameras.txt, Agisoft
Metashape's XML and OpenDroneMap's cameras.json. Those of ROS, OpenCV and Kalibr count pixel
centres as integers; COLMAP's, Metashape's and ours put that of the first at 0.5.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from aquaflow.base.errors import ConfigError, InputError, reason_of
from aquaflow.base.errors.regular_file import MOST_BYTES

Values = dict[str, Any]

FISHEYE = frozenset({"equidistant", "kannala_brandt", "kannalabrandt4", "fisheye"})
"""Names of the model that OpenCV calls fisheye (Kannala and Brandt, 2006)."""
RADTAN = frozenset({"plumb_bob", "rational_polynomial", "radtan", "opencv", "brown", "radial"})
"""Names of OpenCV's usual model."""

COLMAP: dict[str, tuple[str, str]] = {
    "SIMPLE_PINHOLE": ("f cx cy", "none"),
    "PINHOLE": ("fx fy cx cy", "none"),
    "SIMPLE_RADIAL": ("f cx cy k1", "radtan"),
    "RADIAL": ("f cx cy k1 k2", "radtan"),
    "OPENCV": ("fx fy cx cy k1 k2 p1 p2", "radtan"),
    "FULL_OPENCV": ("fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "radtan"),
    "OPENCV_FISHEYE": ("fx fy cx cy k1 k2 k3 k4", "fisheye"),
    "SIMPLE_RADIAL_FISHEYE": ("f cx cy k1", "fisheye"),
    "RADIAL_FISHEYE": ("f cx cy k1 k2", "fisheye"),
}
"""COLMAP's models (src/colmap/sensor/models.h): parameters in order, and their distortion."""


def values_of_file(path: Path) -> Values | None:
    """Of a file that is no YAML: COLMAP's text, Metashape's or OpenCV's XML, OpenDroneMap's JSON;
    None for any other.

    Raises:
        InputError: it cannot be read.
        ConfigError: it is of such a format and holds no camera that we know.
    """
    reader = {".xml": _xml, ".json": _odm, ".txt": _colmap}.get(path.suffix.lower())
    if reader is None:
        return None
    try:
        text = path.read_bytes()[: MOST_BYTES + 1].decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the calibration {path}: {reason_of(error)}") from error
    return _read(path, reader, text)


def values_of_yaml(path: Path, data: Values) -> Values | None:
    """Of a mapping that ROS, OpenCV or Kalibr wrote; None if it is none of these.

    Raises:
        ConfigError: it is one and holds no camera that we know.
    """
    cameras = [each for name, each in data.items() if re.fullmatch(r"cam\d+", name)]
    if cameras:
        return _read(path, _kalibr, cameras)
    if "camera_matrix" in data and "image_width" in data and "distortion_model" in data:
        return _read(path, _ros, data)
    if {"camera_matrix", "cameraMatrix", "Camera_Matrix", "K"} & set(data):
        return _read(path, _opencv, data)
    return None


def _read(path: Path, reader: Any, content: Any) -> Values:
    name = {
        _xml: "Metashape or OpenCV", _odm: "OpenDroneMap", _colmap: "COLMAP", _kalibr: "Kalibr",
        _ros: "ROS", _opencv: "OpenCV",
    }[reader]  # fmt: skip
    try:
        values: Values = reader(content)
    except KeyError as error:
        raise ConfigError(f"{path}: as a calibration of {name}, key {error} is missing") from error
    except (TypeError, ValueError, IndexError, AttributeError, ElementTree.ParseError) as error:
        raise ConfigError(f"{path}: as a calibration of {name}: {error}") from error
    return values


def _values(
    size: Sequence[Any], lens: Sequence[Any], model: str, distortion: Sequence[Any]
) -> Values:
    """``lens``: fx fy cx cy with pixel centres at 0.5."""
    width, height = (int(float(side)) for side in size)
    fx, fy, cx, cy = (float(value) for value in lens)
    numbers = [float(value) for value in distortion]
    kind = "none" if model != "fisheye" and not any(numbers) else model
    return {
        "width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy,
        "distortion_model": kind, "distortion": [] if kind == "none" else numbers,
    }  # fmt: skip


def _model(name: Any) -> str:
    known = str(name).lower()
    if known in FISHEYE:
        return "fisheye"
    if known in RADTAN:
        return "radtan"
    if known in ("none", ""):
        return "none"
    raise ValueError(f"key 'distortion_model': '{name}' is not known")


def _matrix(value: Any) -> list[float]:
    """A matrix as OpenCV and ROS write it, or as lists; row by row."""
    rows = value["data"] if isinstance(value, Mapping) else value
    flat: list[float] = []
    for row in rows:
        flat += [float(each) for each in row] if isinstance(row, (list, tuple)) else [float(row)]
    return flat


def _ros(data: Values) -> Values:
    k = _matrix(data["camera_matrix"])
    d = _matrix(data["distortion_coefficients"])
    lens = (k[0], k[4], k[2] + 0.5, k[5] + 0.5)
    size = (data["image_width"], data["image_height"])
    return _values(size, lens, _model(data["distortion_model"]), d)


def _opencv(data: Values) -> Values:
    names = {name.lower().replace("_", ""): value for name, value in data.items()}
    k = _matrix(names["cameramatrix"] if "cameramatrix" in names else names["k"])
    d: list[float] = []
    for name in ("distortioncoefficients", "distcoeffs", "distortion", "d"):
        if name in names:
            d = _matrix(names[name])
            break
    if "imagewidth" in names:
        size: Sequence[Any] = (names["imagewidth"], names["imageheight"])
    elif "imagesize" in names:
        size = _matrix(names["imagesize"])
    else:
        raise KeyError("image_width")
    model = names.get("distortionmodel", names.get("cameramodel", "radtan"))
    fisheye = str(names.get("fisheyemodel", 0)) not in ("0", "False", "false")
    kind = "fisheye" if fisheye else _model("radtan" if model == "pinhole" else model)
    return _values(size, (k[0], k[4], k[2] + 0.5, k[5] + 0.5), kind, d)


def _kalibr(cameras: list[Values]) -> Values:
    if len(cameras) > 1:
        raise ValueError(f"it holds {len(cameras)} cameras; leave one of them, as cam0")
    (camera,) = cameras
    if camera["camera_model"] != "pinhole":
        raise ValueError(f"key 'camera_model': '{camera['camera_model']}' is not known")
    fx, fy, cx, cy = camera["intrinsics"]
    model, d = _model(camera["distortion_model"]), camera["distortion_coeffs"]
    return _values(camera["resolution"], (fx, fy, cx + 0.5, cy + 0.5), model, d)


def _colmap(text: str) -> Values:
    lines = [line.split() for line in text.splitlines() if line.strip() and line[0] != "#"]
    if len(lines) != 1:
        raise ValueError(f"it holds {len(lines)} cameras; leave the line of one")
    ((_, model, width, height, *numbers),) = lines
    if model not in COLMAP:
        raise ValueError(f"the camera model '{model}' is not known")
    names, kind = COLMAP[model]
    given = dict(zip(names.split(), map(float, numbers), strict=True))
    focal = given.get("f", 0.0)
    lens = (given.get("fx", focal), given.get("fy", focal), given["cx"], given["cy"])
    return _values((width, height), lens, kind, _coefficients(given, kind))


def _coefficients(given: Mapping[str, float], kind: str) -> list[float]:
    """In OpenCV's order."""
    if kind == "fisheye":
        return [given.get(f"k{n}", 0.0) for n in (1, 2, 3, 4)]
    names = ["k1", "k2", "p1", "p2", "k3"]
    names += ["k4", "k5", "k6"] if any(given.get(f"k{n}") for n in (4, 5, 6)) else []
    return [given.get(name, 0.0) for name in names]


def _xml(text: str) -> Values:
    root = ElementTree.fromstring(text)
    if root.tag == "opencv_storage":
        return _opencv({child.tag: _of_storage(child) for child in root})
    found = root if root.tag == "calibration" else root.find(".//calibration")
    if found is None:
        raise ValueError(f"<{root.tag}> holds no <calibration>")
    given = {child.tag: (child.text or "").strip() for child in found}
    kind = given.get("projection", found.get("type", "frame"))
    if kind != "frame":
        raise ValueError(f"the projection '{kind}' is not known; only frame cameras are")
    number = {
        name: float(given.get(name) or 0.0)
        for name in ("cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
    }
    for name in ("k4", "b2", "p3", "p4"):
        if number[name]:
            raise ValueError(f"key '{name}' is not zero: fit the camera without it")
    width, height, f = float(given["width"]), float(given["height"]), float(given["f"])
    lens = (f + number["b1"], f, width / 2 + number["cx"], height / 2 + number["cy"])
    # Metashape's P1 is OpenCV's p2 (manual of Metashape, appendix D).
    d = [number[name] for name in ("k1", "k2", "p2", "p1", "k3")]
    return _values((width, height), lens, "radtan", d)


def _of_storage(element: ElementTree.Element) -> Any:
    data = element.find("data")
    text = (element.text if data is None else data.text) or ""
    numbers = text.split()
    if data is not None or len(numbers) > 1:
        return [float(each) for each in numbers]
    return text.strip()


def _odm(text: str) -> Values:
    cameras = json.loads(text)
    if len(cameras) != 1:
        raise ValueError(f"it holds {len(cameras)} cameras; leave one")
    (camera,) = cameras.values()
    kind = camera["projection_type"]
    width, height = camera["width"], camera["height"]
    side = max(width, height)  # OpenSfM's unit of length
    focal = camera["focal_x"] if "focal_x" in camera else camera["focal"]
    lens = (
        focal * side, camera.get("focal_y", focal) * side,
        width / 2 + camera.get("c_x", 0.0) * side, height / 2 + camera.get("c_y", 0.0) * side,
    )  # fmt: skip
    if kind in ("perspective", "brown", "simple_radial", "radial"):
        return _values((width, height), lens, "radtan", _coefficients(camera, "radtan"))
    if kind in ("fisheye", "fisheye_opencv"):
        return _values((width, height), lens, "fisheye", _coefficients(camera, "fisheye"))
    raise ValueError(f"key 'projection_type': '{kind}' is not known")
