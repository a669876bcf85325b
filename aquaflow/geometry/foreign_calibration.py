"""Calibrations as other programs write them, as the values of ``camera.yaml``.

ROS (camera_info_manager), OpenCV's FileStorage, Kalibr's camchain, files of ORB-SLAM, VINS
(camodocal), OKVIS (SVIn) and EuRoC, COLMAP's cameras.txt, Agisoft Metashape's XML and
OpenDroneMap's cameras.json. COLMAP's, Metashape's and ours put the centre of the first pixel at
0.5; all others count pixel centres as integers.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

from aquaflow.base.errors import ConfigError, InputError, printable, reason_of
from aquaflow.base.errors.regular_file import MOST_BYTES

Values = dict[str, Any]

Model = Literal["none", "radtan", "fisheye"]
MODELS: dict[str, Model] = {
    "equidistant": "fisheye", "kannala_brandt": "fisheye", "kannalabrandt4": "fisheye",
    "fisheye": "fisheye", "plumb_bob": "radtan", "rational_polynomial": "radtan",
    "radtan": "radtan", "opencv": "radtan", "brown": "radtan", "radial": "radtan",
    "radialtangential": "radtan", "radial-tangential": "radtan", "radialtangential8": "radtan",
    "pinhole": "radtan", "kannalabrandt8": "fisheye", "rectified": "none", "none": "none",
    "": "none",
}  # fmt: skip
"""Names of distortion models in other programs: of Kannala and Brandt (2006), which OpenCV calls
fisheye, and of OpenCV's usual one."""

COLMAP: dict[str, tuple[str, Model]] = {
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
    """The values of a file that is no YAML: COLMAP's text, Metashape's or OpenCV's XML,
    OpenDroneMap's JSON; None for any other.

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
    """The values of a mapping that ROS, OpenCV, Kalibr or a SLAM system's user wrote; None if it is
    none of these.

    Raises:
        ConfigError: it is one and holds no camera that we know.
    """
    kalibr = [each for name, each in data.items() if re.fullmatch(r"cam\d+", name)]
    ros = {"camera_matrix", "image_width", "distortion_model"} <= set(data)
    opencv = {"camera_matrix", "cameraMatrix", "Camera_Matrix", "K"} & set(data)
    okvis = data.get("cameras")
    formats = [
        (bool(kalibr), _kalibr, kalibr),
        ("Camera.fx" in data or "Camera1.fx" in data, _orb_slam, data),
        ("model_type" in data, _vins, data),
        ("intrinsics" in data and "resolution" in data, _euroc, data),
        (isinstance(okvis, list), _okvis, okvis),
        (ros, _ros, data),
        (bool(opencv), _opencv, data),
    ]
    return next((_read(path, reader, held) for fits, reader, held in formats if fits), None)


class _NotUnderstoodError(Exception):
    """What of a calibration makes no sense, as a clause that follows its format."""


class _Keys:
    """Values of a calibration by key; what makes no sense is named by it."""

    def __init__(self, values: Any) -> None:
        if not isinstance(values, Mapping):
            raise _NotUnderstoodError("it is no list of keys and values")
        self._values: Mapping[str, Any] = values

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def value(self, key: str, usual: Any = None) -> Any:
        """The value as it stands; ``usual`` where it is missing, unless that is None."""
        if key not in self._values and usual is None:
            raise _NotUnderstoodError(f"key '{key}' is missing")
        return self._values.get(key, usual)

    def number(self, key: str, usual: float | None = None) -> float:
        return self._as_number(key, self.value(key, usual))

    def numbers(self, key: str, least: int = 0) -> list[float]:
        """The numbers of a list, of rows, or of a matrix as ROS and OpenCV write it, row by row."""
        found = self.value(key)
        rows = found.get("data") if isinstance(found, Mapping) else found
        if not isinstance(rows, (list, tuple)):
            raise _NotUnderstoodError(f"key '{key}' is {_quote(found)}, which is no list")
        flat: list[float] = []
        for row in rows:
            cells = row if isinstance(row, (list, tuple)) else [row]
            flat += [self._as_number(key, cell) for cell in cells]
        if len(flat) < least:
            raise _NotUnderstoodError(f"key '{key}' holds {len(flat)} numbers instead of {least}")
        return flat

    def section(self, key: str) -> Mapping[str, Any]:
        """The keys and values below ``key``; none where it is missing."""
        found = self._values.get(key, {})
        if not isinstance(found, Mapping):
            raise _NotUnderstoodError(f"key '{key}' is {_quote(found)}, which is no list of keys")
        return found

    def model(self, key: str, usual: str | None = None) -> Model:
        """The distortion that the text at ``key`` names."""
        name = self.value(key, usual)
        known = MODELS.get(str(name).lower())
        if known is None:
            raise _NotUnderstoodError(f"key '{key}' is {_quote(name)}, which is not known")
        return known

    def _as_number(self, key: str, value: Any) -> float:
        try:
            return float(value)
        except (TypeError, ValueError):
            raise _NotUnderstoodError(f"key '{key}' is {_quote(value)}, which is no number") from (
                None
            )


def _quote(value: Any) -> str:
    return f"'{printable(str(value))[:40]}'"


def _read(path: Path, reader: Any, content: Any) -> Values:
    name = {
        _xml: "Metashape or OpenCV", _odm: "OpenDroneMap", _colmap: "COLMAP", _kalibr: "Kalibr",
        _ros: "ROS", _opencv: "OpenCV", _orb_slam: "ORB-SLAM", _vins: "VINS", _okvis: "OKVIS",
        _euroc: "EuRoC",
    }[reader]  # fmt: skip
    try:
        values: Values = reader(content)
    except _NotUnderstoodError as error:
        raise ConfigError(f"{path}: as a calibration of {name}, {error}") from error
    return values


def _values(
    size: Sequence[float], lens: Sequence[float], model: Model, distortion: Sequence[float]
) -> Values:
    """``lens``: fx fy cx cy with pixel centres at 0.5."""
    kind = "none" if model != "fisheye" and not any(distortion) else model
    fx, fy, cx, cy = lens
    return {
        "width": int(size[0]), "height": int(size[1]), "fx": fx, "fy": fy, "cx": cx, "cy": cy,
        "distortion_model": kind, "distortion": [] if kind == "none" else list(distortion),
    }  # fmt: skip


def _lens_of(k: Sequence[float]) -> tuple[float, float, float, float]:
    """Of a 3 x 3 matrix whose pixel centres are integers."""
    return _at_half(k[0], k[4], k[2], k[5])


def _at_half(fx: float, fy: float, cx: float, cy: float) -> tuple[float, float, float, float]:
    """A lens whose pixel centres are integers, with that of the first at 0.5."""
    return fx, fy, cx + 0.5, cy + 0.5


def _ros(data: Values) -> Values:
    keys = _Keys(data)
    size = (keys.number("image_width"), keys.number("image_height"))
    lens, model = _lens_of(keys.numbers("camera_matrix", 9)), keys.model("distortion_model")
    return _values(size, lens, model, keys.numbers("distortion_coefficients"))


def _opencv(data: Values) -> Values:
    keys = _Keys({name.lower().replace("_", ""): value for name, value in data.items()})
    lens = _lens_of(keys.numbers("cameramatrix" if "cameramatrix" in keys else "k", 9))
    names = ("distortioncoefficients", "distcoeffs", "distortion", "d")
    d = next((keys.numbers(name) for name in names if name in keys), [])
    if "imagesize" in keys and "imagewidth" not in keys:
        size = keys.numbers("imagesize", 2)
    elif "imagewidth" in keys:
        size = [keys.number("imagewidth"), keys.number("imageheight")]
    else:
        raise _NotUnderstoodError("key 'image_width' is missing")
    if str(keys.value("fisheyemodel", 0)).lower() not in ("0", "false"):
        return _values(size, lens, "fisheye", d)
    named = "distortionmodel" if "distortionmodel" in keys else "cameramodel"
    model = "radtan" if keys.value(named, "pinhole") == "pinhole" else keys.model(named)
    return _values(size, lens, model, d)


def _kalibr(cameras: list[Values]) -> Values:
    if len(cameras) > 1:
        raise _NotUnderstoodError(f"it holds {len(cameras)} cameras; leave one of them, as cam0")
    return _pinhole(_Keys(cameras[0]), "distortion_coeffs")


def _euroc(data: Values) -> Values:
    """The ``sensor.yaml`` of a camera in EuRoC's layout."""
    return _pinhole(_Keys(data), "distortion_coefficients")


def _pinhole(keys: _Keys, distortion: str) -> Values:
    if (model := keys.value("camera_model")) != "pinhole":
        raise _NotUnderstoodError(f"key 'camera_model' is {_quote(model)}, which is not known")
    fx, fy, cx, cy = keys.numbers("intrinsics", 4)[:4]
    size, d = keys.numbers("resolution", 2), keys.numbers(distortion)
    return _values(size, _at_half(fx, fy, cx, cy), keys.model("distortion_model"), d)


def _orb_slam(data: Values) -> Values:
    """Settings of ORB-SLAM2 and 3 (its Calibration_Tutorial)."""
    if "Camera2.fx" in data:
        raise _NotUnderstoodError("it holds 2 cameras; leave Camera1")
    lens_prefix = "Camera1." if "Camera1.fx" in data else "Camera."
    lens = {name.removeprefix(lens_prefix): value for name, value in data.items()}
    keys, shared = _Keys(lens), _Keys(data)
    model = shared.model("Camera.type", "PinHole")
    size = shared.number("Camera.width"), shared.number("Camera.height")
    fx, fy, cx, cy = (keys.number(name) for name in ("fx", "fy", "cx", "cy"))
    return _values(size, _at_half(fx, fy, cx, cy), model, _d_of(keys, model))


def _vins(data: Values) -> Values:
    """A camera file of VINS, which camodocal wrote (EquidistantCamera.cc counts from k2)."""
    keys = _Keys(data)
    size = keys.number("image_width"), keys.number("image_height")
    model = keys.model("model_type")
    given = {**keys.section("distortion_parameters"), **keys.section("projection_parameters")}
    inside = _Keys(given)
    if model == "fisheye":
        fx, fy, cx, cy = (inside.number(name) for name in ("mu", "mv", "u0", "v0"))
        d = [inside.number(f"k{n}", 0.0) for n in (2, 3, 4, 5)]
    else:
        fx, fy, cx, cy = (inside.number(name) for name in ("fx", "fy", "cx", "cy"))
        d = _d_of(inside, model)
    return _values(size, _at_half(fx, fy, cx, cy), model, d)


def _okvis(cameras: list[Any]) -> Values:
    """The cameras of a configuration of OKVIS, OKVIS2 or SVIn."""
    if len(cameras) != 1:
        raise _NotUnderstoodError(f"it holds {len(cameras)} cameras; leave one of them")
    keys = _Keys(cameras[0])
    size, d = keys.numbers("image_dimension", 2), keys.numbers("distortion_coefficients")
    (fx, fy), (cx, cy) = keys.numbers("focal_length", 2)[:2], keys.numbers("principal_point", 2)[:2]
    return _values(size, _at_half(fx, fy, cx, cy), keys.model("distortion_type"), d)


def _colmap(text: str) -> Values:
    lines = [line.split() for line in text.splitlines() if line.strip() and line[0] != "#"]
    if len(lines) != 1:
        raise _NotUnderstoodError(f"it holds {len(lines)} cameras; leave the line of one")
    words = lines[0]
    if len(words) < 4 or words[1] not in COLMAP:
        named = f"model {_quote(words[1])} is not known" if len(words) > 3 else "its line is short"
        raise _NotUnderstoodError(named)
    names, kind = COLMAP[words[1]]
    if len(words) != 4 + len(names.split()):
        raise _NotUnderstoodError(f"{words[1]} has {len(words) - 4} numbers instead of: {names}")
    keys = _Keys(dict(zip(("WIDTH", "HEIGHT", *names.split()), words[2:], strict=True)))
    fx, fy = (keys.number("f" if "f" in keys else name) for name in ("fx", "fy"))
    size = (keys.number("WIDTH"), keys.number("HEIGHT"))
    return _values(size, (fx, fy, keys.number("cx"), keys.number("cy")), kind, _d_of(keys, kind))


def _d_of(keys: _Keys, kind: Model) -> list[float]:
    """Coefficients in OpenCV's order; those that are missing are zero."""
    if kind == "fisheye":
        return [keys.number(f"k{n}", 0.0) for n in (1, 2, 3, 4)]
    names = ["k1", "k2", "p1", "p2", "k3"]
    names += ["k4", "k5", "k6"] if any(keys.number(f"k{n}", 0.0) for n in (4, 5, 6)) else []
    return [keys.number(name, 0.0) for name in names]


def _xml(text: str) -> Values:
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise _NotUnderstoodError(f"it is damaged XML: {reason_of(error)}") from error
    if root.tag == "opencv_storage":
        return _opencv({child.tag: _of_storage(child) for child in root})
    found = root if root.tag == "calibration" else root.find(".//calibration")
    if found is None:
        raise _NotUnderstoodError(f"<{root.tag}> holds no <calibration>")
    given = {child.tag: text for child in found if (text := (child.text or "").strip())}
    keys = _Keys(given)
    kind = given.get("projection", found.get("type", "frame"))
    if kind != "frame":
        raise _NotUnderstoodError(f"projection {_quote(kind)} is not known; only 'frame' is")
    for name in ("k4", "b2", "p3", "p4"):
        if keys.number(name, 0.0):
            raise _NotUnderstoodError(f"key '{name}' is not zero: fit the camera without it")
    width, height, f = (keys.number(name) for name in ("width", "height", "f"))
    centre = (width / 2 + keys.number("cx", 0.0), height / 2 + keys.number("cy", 0.0))
    # Metashape's P1 is OpenCV's p2 (manual of Metashape, appendix D).
    d = [keys.number(name, 0.0) for name in ("k1", "k2", "p2", "p1", "k3")]
    return _values((width, height), (f + keys.number("b1", 0.0), f, *centre), "radtan", d)


def _of_storage(element: ElementTree.Element) -> Any:
    data = element.find("data")
    text = (element.text if data is None else data.text) or ""
    return text.split() if data is not None or len(text.split()) > 1 else text.strip()


def _odm(text: str) -> Values:
    try:
        cameras = json.loads(text)
    except ValueError as error:
        raise _NotUnderstoodError("it is damaged JSON") from error
    if not isinstance(cameras, dict) or len(cameras) != 1:
        held = len(cameras) if isinstance(cameras, dict) else "no"
        raise _NotUnderstoodError(f"it holds {held} cameras; leave one")
    keys = _Keys(next(iter(cameras.values())))
    kind = {
        "perspective": "radtan", "brown": "radtan", "simple_radial": "radtan", "radial": "radtan",
        "fisheye": "fisheye", "fisheye_opencv": "fisheye",
    }.get(str(named := keys.value("projection_type")))  # fmt: skip
    if kind is None:
        raise _NotUnderstoodError(f"key 'projection_type' is {_quote(named)}, which is not known")
    width, height = keys.number("width"), keys.number("height")
    side = max(width, height)  # OpenSfM's unit of length
    focal = keys.number("focal_x" if "focal_x" in keys else "focal")
    lens = (
        focal * side, keys.number("focal_y", focal) * side,
        width / 2 + keys.number("c_x", 0.0) * side, height / 2 + keys.number("c_y", 0.0) * side,
    )  # fmt: skip
    model = MODELS[kind]
    return _values((width, height), lens, model, _d_of(keys, model))
