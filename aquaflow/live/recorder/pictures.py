"""Pictures as messages: the bytes that the camera delivered, else encoded here."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.config.service import RecordingConfig
from aquaflow.types import CameraModel, EncodedPicture, Frame

FOXGLOVE_DISTORTION = {"none": "", "radtan": "plumb_bob", "fisheye": "kannala_brandt"}
"""Distortion models by Foxglove's names."""
PLUMB_BOB_COEFFICIENTS = 5
"""That ``plumb_bob`` has."""


def picture_message(frame: Frame, name: str, settings: RecordingConfig) -> Any:
    """``frame`` as foxglove.CompressedImage, CompressedVideo or RawImage (protobuf)."""
    encoded = frame.encoded if settings.keep_received else None
    if encoded is None and settings.picture != "raw":
        encoded = encode(frame.image, settings)
    message = _empty(encoded)
    message.timestamp.FromNanoseconds(frame.t_ns)
    message.frame_id = name
    if encoded is not None:
        message.format, message.data = encoded.format, encoded.data
        return message
    message.height, message.width = frame.image.shape[:2]
    message.encoding, message.step = "rgb8", 3 * frame.image.shape[1]
    message.data = np.ascontiguousarray(frame.image).tobytes()
    return message


def encode(
    image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    settings: RecordingConfig,
) -> EncodedPicture:
    """JPEG or PNG, by the settings."""
    import cv2

    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    if settings.picture == "png":
        # Measured on reef_clip at 640x480: 10 ms and 0.61 MB; OpenCV's fastest level alone takes
        # 24 ms for 0.55 MB.
        flags = [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
        flags += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]
        return EncodedPicture("png", cv2.imencode(".png", bgr, flags)[1].tobytes())
    flags = [cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality]
    return EncodedPicture("jpeg", cv2.imencode(".jpg", bgr, flags)[1].tobytes())


def mask_message(
    mask: npt.NDArray[np.bool_],  # [H, W]
    t_ns: int,
    name: str,
) -> Any:
    """A frame's mask as a PNG, 255 where the pixel shows the scene."""
    import cv2

    png = cv2.imencode(".png", mask.astype(np.uint8) * 255)[1].tobytes()
    message = _empty(EncodedPicture("png", png))
    message.timestamp.FromNanoseconds(t_ns)
    message.frame_id, message.format, message.data = name, "png", png
    return message


def calibration_message(camera: CameraModel, t_ns: int, name: str) -> Any:
    """``camera`` as foxglove.CameraCalibration; OpenCV's pixel centres are integers, ours not."""
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

    message = CameraCalibration()
    message.timestamp.FromNanoseconds(t_ns)
    message.frame_id = name
    message.width, message.height = camera.width, camera.height
    longer = len(camera.distortion) > PLUMB_BOB_COEFFICIENTS
    model = FOXGLOVE_DISTORTION[camera.distortion_model]
    message.distortion_model = "rational_polynomial" if longer and model == "plumb_bob" else model
    message.D.extend(camera.distortion)
    K = camera.K
    K[:2, 2] -= 0.5
    message.K.extend(K.ravel())
    message.R.extend(np.eye(3).ravel())
    message.P.extend(np.hstack([K, np.zeros((3, 1))]).ravel())
    return message


def camera_to_json(camera: CameraModel) -> str:
    """Every bit of the calibration, for reading back."""
    return json.dumps(asdict(camera))


def _empty(encoded: EncodedPicture | None) -> Any:
    if encoded is None:
        from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

        return RawImage()
    if encoded.format == "h264":
        from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo

        return CompressedVideo()
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    return CompressedImage()
