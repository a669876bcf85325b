"""What a dive knows as ROS 2 messages. Times are nanoseconds, lengths those of the map."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.point_cloud import PointCloud
from aquaflow.dive.ros.topics import FrameTransform, constant, message
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.water.mounting import Lamp

Array = npt.NDArray[np.float64]

NS = 1_000_000_000
JPEG_QUALITY = 90
"""Of pictures: 10 times smaller than PNG, with artefacts below the noise of water."""
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4"), ("sigma", "<f4")])
"""A point of the cloud; ``rgb`` holds the bytes 0, red, green, blue, high to low, and is declared
as a float, as PCL, RViz and Foxglove expect it."""
MOST_POINTS = 1 << 20
"""Of a cloud in one message, 21 MB: what Foxglove turns without delay. LAZ and E57 have all."""
HALF_PIXEL = 0.5
"""ROS's first pixel has its centre at (0, 0), AquaFlow's at (0.5, 0.5)."""
OK, WARN = 0, 1
"""Levels of DiagnosticStatus."""
CHANNELS = ("red", "green", "blue")


def header(t_ns: int, frame_id: str) -> Any:
    """std_msgs/Header."""
    sec, nanosec = divmod(t_ns, NS)
    stamp = message("builtin_interfaces/msg/Time", sec=int(sec), nanosec=int(nanosec))
    return message("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def _vector(name: str, values: Array) -> Any:  # values: [3]
    x, y, z = (float(value) for value in values)
    return message(f"geometry_msgs/msg/{name}", x=x, y=y, z=z)


def _quaternion(T: Sim3) -> Any:
    w, x, y, z = (float(value) for value in T.quaternion)
    return message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _pose(T: Sim3) -> Any:
    return message(
        "geometry_msgs/msg/Pose", position=_vector("Point", T.t), orientation=_quaternion(T)
    )


def transforms(t_ns: int, links: Iterable[FrameTransform]) -> Any:
    """tf2_msgs/TFMessage; the links are rigid."""
    stamped = [
        message(
            "geometry_msgs/msg/TransformStamped",
            header=header(t_ns, link.parent),
            child_frame_id=link.child,
            transform=message(
                "geometry_msgs/msg/Transform",
                translation=_vector("Vector3", link.T.t),
                rotation=_quaternion(link.T),
            ),
        )
        for link in links
    ]
    return message("tf2_msgs/msg/TFMessage", transforms=stamped)


def pose(
    t_ns: int,
    link: FrameTransform,
    sigma_m: float | None,
    heading_sigma_rad: float | None,
    tilt_sigma_rad: float | None,
) -> Any:
    """geometry_msgs/PoseWithCovarianceStamped of a frame in its parent; 1 sigma each.

    The covariance (x, y, z, turns about x, y, z of the parent) is zero where nothing is known, as
    ROS has it. A position is given the sigma of its least known direction in all three.
    """
    sigmas = [sigma_m] * 3 + [tilt_sigma_rad] * 2 + [heading_sigma_rad]
    variances = np.array([0.0 if sigma is None else sigma**2 for sigma in sigmas])
    return message(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=header(t_ns, link.parent),
        pose=message(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=_pose(link.T),
            covariance=np.diag(variances).ravel(),
        ),
    )


def path(t_ns: int, frame_id: str, poses: Sequence[tuple[int, Sim3]]) -> Any:
    """nav_msgs/Path through ``poses``, each with its time."""
    stamped = [
        message("geometry_msgs/msg/PoseStamped", header=header(at_ns, frame_id), pose=_pose(T))
        for at_ns, T in poses
    ]
    return message("nav_msgs/msg/Path", header=header(t_ns, frame_id), poses=stamped)


def jpeg(
    t_ns: int,
    frame_id: str,
    picture: npt.NDArray[np.uint8],  # [H, W, 3] RGB
) -> Any:
    """sensor_msgs/CompressedImage.

    Raises:
        InputError: OpenCV cannot encode it.
    """
    import cv2

    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), options)
    if not done:
        raise InputError(f"OpenCV cannot encode a picture of shape {picture.shape} as JPEG")
    return message(
        "sensor_msgs/msg/CompressedImage",
        header=header(t_ns, frame_id), format="jpeg", data=data.ravel(),
    )  # fmt: skip


def camera_info(t_ns: int, frame_id: str, camera: CameraModel) -> Any:
    """sensor_msgs/CameraInfo of a pinhole camera: its pictures are undistorted."""
    K = camera.K
    K[:2, 2] -= HALF_PIXEL
    region = message(
        "sensor_msgs/msg/RegionOfInterest",
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False,
    )  # fmt: skip
    return message(
        "sensor_msgs/msg/CameraInfo",
        header=header(t_ns, frame_id), height=camera.height, width=camera.width,
        distortion_model="plumb_bob", d=np.zeros(5), k=K.ravel(), r=np.eye(3).ravel(),
        p=np.hstack([K, np.zeros((3, 1))]).ravel(), binning_x=0, binning_y=0, roi=region,
    )  # fmt: skip


def packed_points(cloud: PointCloud) -> npt.NDArray[np.void]:
    """[N] records of ``POINT``, in the cloud's frame and unit: all of its points, or every n-th one
    of more than MOST_POINTS."""
    step, first, packed = points_step(cloud), 0, [np.zeros(0, POINT)]
    for chunk in cloud.chunks():
        chosen = slice(-first % step, None, step)
        packed.append(
            point_records(chunk.positions[chosen], chunk.colours[chosen], chunk.sigma[chosen])
        )
        first += len(chunk.positions)
    return np.concatenate(packed)


def points_step(cloud: PointCloud) -> int:
    """Of how many points in a row :func:`packed_points` has one."""
    return max(1, -(-len(cloud) // MOST_POINTS))


def point_records(
    positions: npt.NDArray[np.floating],  # [N, 3]
    colours: npt.NDArray[np.uint8],  # [N, 3] RGB
    sigma: npt.NDArray[np.floating],  # [N]
) -> npt.NDArray[np.void]:
    """[N] records of ``POINT``."""
    points = np.zeros(len(positions), POINT)
    for column, name in enumerate("xyz"):
        points[name] = positions[:, column]
    red, green, blue = colours.astype(np.uint32).T
    points["rgb"] = red << 16 | green << 8 | blue
    points["sigma"] = sigma
    return points


def point_cloud(
    t_ns: int,
    frame_id: str,
    points: npt.NDArray[np.void],  # [N] records of POINT
) -> Any:
    """sensor_msgs/PointCloud2."""
    name = "sensor_msgs/msg/PointField"
    float32 = constant(name, "FLOAT32")
    fields = [
        message(name, name=field, offset=POINT.fields[field][1], datatype=float32, count=1)
        for field in POINT.names or ()
        if POINT.fields is not None
    ]
    return message(
        "sensor_msgs/msg/PointCloud2",
        header=header(t_ns, frame_id), height=1, width=len(points), fields=fields,
        is_bigendian=False, point_step=POINT.itemsize, row_step=POINT.itemsize * len(points),
        data=np.frombuffer(points.tobytes(), np.uint8), is_dense=True,
    )  # fmt: skip


def status(level: int, name: str, said: str, values: Mapping[str, object]) -> Any:
    """diagnostic_msgs/DiagnosticStatus; values are written as text."""
    pairs = [
        message("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
        for key, value in values.items()
    ]
    return message(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=level, name=name, message=said, hardware_id="aquaflow", values=pairs,
    )  # fmt: skip


def lamp_values(lamp: Lamp | None, unit: str) -> dict[str, object]:
    """Values of a status of what is known of the vehicle's lamps, lengths in ``unit``."""
    if lamp is None:
        return {}
    values: dict[str, object] = {
        f"lamps, share of the light at {lamp.range:.3g} {unit}": lamp.share
    }
    if lamp.share_sigma is not None:
        values["lamps, 1 sigma of the share"] = lamp.share_sigma
    if lamp.places is not None and lamp.places_sigma is not None:
        for number, place in enumerate(lamp.places, 1):
            values[f"lamp {number} right of and below the camera, {unit}"] = _few_digits(place)
        values[f"lamps, 1 sigma of the places, {unit}"] = _few_digits(lamp.places_sigma)
    return values


def _few_digits(lengths: Sequence[float]) -> str:
    return ", ".join(f"{length:.3g}" for length in lengths)


def diagnostics(t_ns: int, statuses: Sequence[Any]) -> Any:
    """diagnostic_msgs/DiagnosticArray."""
    return message(
        "diagnostic_msgs/msg/DiagnosticArray", header=header(t_ns, ""), status=list(statuses)
    )


def number(value: float) -> Any:
    """std_msgs/Float64; its time is that of the file or the connection."""
    return message("std_msgs/msg/Float64", data=float(value))


def fix(t_ns: int, frame_id: str, latitude_deg: float, longitude_deg: float) -> Any:
    """sensor_msgs/NavSatFix (WGS 84): where the camera was, by the map and its origin; its height
    above the ellipsoid is not known."""
    return message(
        "sensor_msgs/msg/NavSatFix",
        header=header(t_ns, frame_id),
        status=message("sensor_msgs/msg/NavSatStatus", status=0, service=0),
        latitude=latitude_deg, longitude=longitude_deg, altitude=math.nan,
        position_covariance=np.zeros(9), position_covariance_type=0,
    )  # fmt: skip
