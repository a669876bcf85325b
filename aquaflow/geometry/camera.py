"""Camera models: pinhole with OpenCV distortion, read from ``camera.yaml``.

Pixel convention: the centre of the top-left pixel is (0.5, 0.5), so the centre of a W-wide image
is W / 2. OpenCV's convention is half a pixel less; that is applied where OpenCV is called.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from aquaflow.base.errors import ConfigError, path_of_key, words_of
from aquaflow.base.errors.regular_file import read_mapping
from aquaflow.base.storage.atomic import atomic_write, write_yaml
from aquaflow.geometry.foreign_calibration import MODELS, values_of_file, values_of_yaml
from aquaflow.geometry.port import DomePortFile, FlatPortFile, Port, PortFile, as_stated, port_of

DistortionModel = Literal["none", "radtan", "fisheye"]

GUESSED_FOCAL_WIDTHS = 0.85
"""Focal length over width when nothing is known. The shared clips in water span 0.63 (GoPro wide)
to 1.10 (SLR behind a dome); this is the geometric mean of the two."""

ASPECT_TOLERANCE = 0.01
"""A calibration for another resolution may be scaled if the aspect ratio differs by less."""

MIN_DEPTH = 1e-9
"""Projection divides by no smaller depth; what lies behind the camera lands far outside."""


@dataclass(frozen=True)
class CameraModel:
    """Intrinsics in pixels for images of ``width`` x ``height``; behind a port they are of air."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: DistortionModel = "none"
    distortion: tuple[float, ...] = ()
    """OpenCV order: k1 k2 p1 p2 [k3 ...] for ``radtan``, k1..k4 for ``fisheye``."""
    port: Port | None = None
    """The window to the water; None if there is none, or the calibration was made in water."""
    calibrated: bool = True
    """False while the focal length is only a guess."""

    @property
    def K(self) -> npt.NDArray[np.float64]:
        """[3, 3] intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_distorted(self) -> bool:
        """True for every fisheye, and where a coefficient of ``radtan`` is not zero."""
        if self.distortion_model == "fisheye":
            return True  # without coefficients it is equidistant, no pinhole
        return self.distortion_model == "radtan" and any(k != 0.0 for k in self.distortion)

    @property
    def coefficients(self) -> npt.NDArray[np.float64]:
        """[N] of the distortion as OpenCV takes them."""
        return np.array(self.distortion or (0.0, 0.0, 0.0, 0.0))

    @property
    def is_pinhole(self) -> bool:
        """True if neither distortion nor a port bends its rays."""
        return not self.is_distorted and self.port is None

    def resize(self, width: int, height: int) -> CameraModel:
        """The same camera for the same picture resized to ``width`` x ``height``."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    def crop(self, x: int, y: int, width: int, height: int) -> CameraModel:
        """The same camera for the part of its picture that starts at (x, y)."""
        return replace(self, width=width, height=height, cx=self.cx - x, cy=self.cy - y)

    def with_focal_scaled(self, factor: float) -> CameraModel:
        """The same camera with its focal length multiplied by ``factor``."""
        return replace(self, fx=self.fx * factor, fy=self.fy * factor)

    def pixel_centres(self) -> npt.NDArray[np.float64]:
        """[H, W, 2] pixel coordinates of every pixel's centre."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return np.stack([u, v], axis=-1)

    def unproject(
        self,
        pixels: npt.NDArray[np.floating],  # [..., 2] px, undistorted
    ) -> npt.NDArray[np.float64]:
        """Points [..., 3] at z = 1 on the rays of ``pixels``, camera frame."""
        x = (pixels[..., 0] - self.cx) / self.fx
        y = (pixels[..., 1] - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float64)

    def project(
        self,
        points: npt.NDArray[np.floating],  # [..., 3], camera frame, z > 0
    ) -> npt.NDArray[np.float64]:
        """Undistorted pixel coordinates [..., 2]; z is kept away from zero."""
        z = np.maximum(points[..., 2], MIN_DEPTH)
        u = self.fx * points[..., 0] / z + self.cx
        v = self.fy * points[..., 1] / z + self.cy
        return np.stack([u, v], axis=-1)


def guess_camera(width: int, height: int) -> CameraModel:
    """A pinhole camera with a typical underwater focal length, marked as not calibrated."""
    focal = GUESSED_FOCAL_WIDTHS * width
    return CameraModel(width, height, focal, focal, width / 2.0, height / 2.0, calibrated=False)


MOST_SIDE_PX = 1 << 16
"""Of a picture; the largest sensors have a fifth of that."""

FOCAL_SIDES = (0.01, 100.0)
"""Focal lengths over the picture's longer side that a lens may have: a fisheye has 0.2, a telephoto
lens 20."""

COEFFICIENTS = {"radtan": (4, 5, 8, 12, 14), "fisheye": (4,)}
"""Numbers of distortion coefficients that OpenCV takes; none at all means no distortion."""


class CameraFile(BaseModel):
    """The ``camera.yaml`` format."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    width: int = Field(gt=0, le=MOST_SIDE_PX)
    height: int = Field(gt=0, le=MOST_SIDE_PX)
    model: Literal["pinhole"] = "pinhole"
    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float
    distortion_model: Literal["none", "radial", "radtan", "opencv", "fisheye"] = "none"
    distortion: list[float] = Field(default_factory=list, max_length=14)
    port: PortFile | None = None

    @field_validator("port", mode="before")
    @classmethod
    def _port_has_measures(cls, value: Any) -> Any:
        return as_stated(value)

    @property
    def kind(self) -> DistortionModel:
        """The distortion model by the name that we use for it."""
        if self.distortion_model in ("none", "fisheye"):
            return self.distortion_model  # type: ignore[return-value]
        return "radtan"

    def camera(self) -> CameraModel:
        """The camera to compute with."""
        return CameraModel(
            self.width,
            self.height,
            self.fx,
            self.fy,
            self.cx,
            self.cy,
            distortion_model=self.kind,
            distortion=tuple(self.distortion),
            port=port_of(self.port),
        )

    @model_validator(mode="after")
    def _is_a_camera(self) -> CameraFile:
        """What no single key shows."""
        least, most = (share * max(self.width, self.height) for share in FOCAL_SIDES)
        for key in ("fx", "fy"):
            if not least <= getattr(self, key) <= most:
                raise ValueError(f"{key} is no focal length, in pixels, of such a picture")
        for key, side in (("cx", self.width), ("cy", self.height)):
            if abs(getattr(self, key)) > FOCAL_SIDES[1] * side:
                raise ValueError(f"{key} lies far outside the picture")
        counts = COEFFICIENTS.get(self.kind)
        if counts and self.distortion and len(self.distortion) not in counts:
            known = " or ".join(map(str, counts))
            raise ValueError(
                f"distortion has {len(self.distortion)} numbers, {self.kind} takes {known}"
            )
        return self


def load_camera(path: Path, inside: bool = False) -> CameraModel:
    """Read a calibration, ours or one of :mod:`aquaflow.geometry.foreign_calibration`; ``inside``:
    of a folder that others may have made.

    Raises:
        InputError: the file is not there or is not YAML.
        ConfigError: a key is unknown, missing, or its value is out of range; or a port is named
            without its measures.
    """
    data = None if inside else values_of_file(path)
    if data is None:
        hint = "write width, height, fx, fy, cx and cy, each as `key: value`"
        data = read_mapping(path, "calibration", hint, inside)
        data = values_of_yaml(path, data) or data
    if (model := MODELS.get(str(data.get("distortion_model")).lower())) is not None:
        data["distortion_model"] = model
    try:
        file = CameraFile.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"{path}: {_what_is_wrong(error)}") from error
    camera = file.camera()
    _check_principal_point(path, camera)
    return camera


def _check_principal_point(path: Path, camera: CameraModel) -> None:
    """A calibration made at one picture size and stated for another is the usual slip.

    Raises:
        ConfigError: the optical axis does not meet the picture.
    """
    if not (0.0 < camera.cx < camera.width and 0.0 < camera.cy < camera.height):
        raise ConfigError(
            f"{path}: the principal point ({camera.cx:.0f}, {camera.cy:.0f}) lies outside of the "
            f"picture of {camera.width} x {camera.height} pixels; give the size of the pictures by "
            "which the camera was calibrated"
        )


def camera_of_values(values: dict[str, Any]) -> CameraModel:
    """The camera whose ``asdict`` gave ``values``, read back from JSON with every bit.

    A port in the form that AquaFlow 0.1 wrote, by name and without its measures, is left out.

    Raises:
        KeyError, TypeError, ValueError: the values are no camera.
    """
    plain = {name: value for name, value in values.items() if name != "calibrated"}
    if has_unmeasured_port(values) or plain["port"] == UNMEASURED | {"kind": "none"}:
        plain["port"] = None
    camera = CameraFile.model_validate_json(json.dumps(plain), strict=True).camera()
    return replace(camera, calibrated=bool(values["calibrated"]))


UNMEASURED = {
    "thickness_m": 0.0,
    "distance_m": 0.0,
    "refractive_index_glass": 1.49,
    "refractive_index_water": 1.34,
}
"""What AquaFlow 0.1 wrote of every port besides its name."""


def has_unmeasured_port(values: dict[str, Any]) -> bool:
    """True for a camera that AquaFlow 0.1 wrote with a port's name and no measure of it."""
    return values["port"] in [UNMEASURED | {"kind": kind} for kind in ("flat", "dome")]


def _what_is_wrong(error: ValidationError) -> str:
    # A misspelt key is also a missing one; the one that was written says more.
    first = sorted(error.errors(), key=lambda each: each["type"] != "extra_forbidden")[0]
    place = first["loc"]
    fields: dict[str, Any] = CameraFile.model_fields
    if len(place) > 1 and place[0] == "port":  # its second part says which model was tried
        fields = (FlatPortFile if place[1] == "flat" else DomePortFile).model_fields
        place = (place[0], *place[2:])
    key = path_of_key(place)
    named = f"key '{key}': " if key else ""
    return f"{named}{words_of(first['msg'])}; known keys are {', '.join(fields)}"


# --------------------------------------------------------------------------------------------------
# A camera's calibration as a file that :func:`aquaflow.geometry.camera.load_camera` reads.


def save_camera(camera: CameraModel, path: Path, comment: str = "") -> None:
    """Write ``camera`` to ``path``, after a ``comment`` of one line.

    Raises:
        InputError: the file cannot be written.
    """
    data = asdict(camera) | {"distortion": list(camera.distortion), "model": "pinhole"}
    del data["calibrated"]
    data["port"] = "none" if camera.port is None else _plain(asdict(camera.port))
    write_yaml(path, data, comment)


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}


def save_for_others(camera: CameraModel, folder: Path) -> list[Path]:
    """Write ``camera_ros.yaml`` and ``camera_opencv.yaml``, as ROS (camera_info_manager) and
    OpenCV's FileStorage read them; their pixel centres are integers. A port is in neither.

    Raises:
        InputError: a file cannot be written.
    """
    fisheye = camera.distortion_model == "fisheye"
    cx, cy = camera.cx - 0.5, camera.cy - 0.5
    k = [camera.fx, 0.0, cx, 0.0, camera.fy, cy, 0.0, 0.0, 1.0]
    d = [float(value) for value in camera.distortion] or [0.0] * (4 if fisheye else 5)
    p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
    matrix = {"rows": 3, "cols": 3, "data": k}
    usual = "plumb_bob" if len(d) <= 5 else "rational_polynomial"
    size = {"image_width": camera.width, "image_height": camera.height}
    ros = folder / "camera_ros.yaml"
    write_yaml(
        ros,
        size
        | {
            "camera_name": "camera",
            "camera_matrix": matrix,
            "distortion_model": "equidistant" if fisheye else usual,
            "distortion_coefficients": {"rows": 1, "cols": len(d), "data": d},
            "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
            "projection_matrix": {"rows": 3, "cols": 4, "data": p},
        },
    )
    opencv = folder / "camera_opencv.yaml"
    lines = ["%YAML:1.0", "---", *(f"{name}: {value}" for name, value in size.items())]
    lines += [f"fisheye_model: {int(fisheye)}"]
    for name, rows, columns, data in (
        ("camera_matrix", 3, 3, k),
        ("distortion_coefficients", 1, len(d), d),
    ):
        lines += [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}"]
        lines += ["   dt: d", f"   data: [ {', '.join(f'{value:.17g}' for value in data)} ]"]
    with atomic_write(opencv) as stream:
        stream.write(("\n".join(lines) + "\n").encode())
    return [ros, opencv]


# --------------------------------------------------------------------------------------------------
# Values of a field at pixel positions (docs/conventions.md: a pixel's centre is at + 0.5).

Scalar = TypeVar("Scalar", bound=np.generic)


def at_pixels(
    field: npt.NDArray[Scalar],  # [H, W]
    pixels: npt.NDArray[np.float64] | npt.NDArray[np.float32],  # [M, 2] px
) -> npt.NDArray[Scalar]:
    """[M] values of the pixels' own cells."""
    height, width = field.shape
    column = np.clip(np.floor(pixels[:, 0]).astype(np.int64), 0, width - 1)
    row = np.clip(np.floor(pixels[:, 1]).astype(np.int64), 0, height - 1)
    return field[row, column]
