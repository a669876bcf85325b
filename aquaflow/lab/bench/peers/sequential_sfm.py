"""The accurate, slow end: COLMAP's sequential structure from motion, through pycolmap."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import cv2

from aquaflow.base.errors import AquaFlowError, NotMappedError
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.bench.peers.dive import PeerResult
from aquaflow.types import Frame

SEED = 0
"""The same pictures give the same poses."""


class PeerMissingError(AquaFlowError):
    """The peer is not installed here."""


def solve(frames: list[Frame]) -> PeerResult:
    """COLMAP with its default settings; intrinsics held where they were calibrated.

    Raises:
        PeerMissingError: pycolmap is not installed.
        NotMappedError: COLMAP found no reconstruction.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise PeerMissingError(
            "not available: pycolmap is not installed; pip install 'aquaflow[peers]'"
        ) from error
    pycolmap.logging.minloglevel = 3  # its progress is not ours to print
    with tempfile.TemporaryDirectory(prefix="aquaflow_sfm_") as name:
        folder = Path(name)
        for i, frame in enumerate(frames):
            cv2.imwrite(str(folder / _file(i)), cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
        started = time.perf_counter()
        model = _reconstruct(pycolmap, folder, frames[0])
        wall_s = time.perf_counter() - started
    number = {_file(i): i for i in range(len(frames))}
    poses = {}
    for image in model.images.values():
        if image.has_pose:
            cam_from_world = image.cam_from_world().matrix()
            R, t = cam_from_world[:, :3], cam_from_world[:, 3]
            poses[number[image.name]] = Sim3(R.T, -R.T @ t, 1.0)
    # It places no frame before it has seen all: the first pose comes with the last.
    return PeerResult(poses, wall_s, wall_s, features=features_of(pycolmap))


def _reconstruct(pycolmap: Any, folder: Path, frame: Frame) -> Any:
    database, camera = folder / "database.db", frame.camera
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    reader.camera_params = f"{camera.fx},{camera.fy},{camera.cx},{camera.cy}"
    pycolmap.extract_features(
        database, folder, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
        device=pycolmap.Device.cpu,
    )  # fmt: skip
    pycolmap.match_sequential(database, device=pycolmap.Device.cpu)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = SEED
    options.ba_refine_focal_length = not camera.calibrated
    options.ba_refine_extra_params = False
    models = pycolmap.incremental_mapping(database, folder, folder / "models", options)
    if not models:
        raise NotMappedError("COLMAP found no reconstruction of these frames")
    return max(models.values(), key=lambda model: model.num_reg_images())


def features_of(pycolmap: Any) -> str:
    """Kind of features and of matcher that this pycolmap runs with default settings.

    Since COLMAP 4 learned features are a choice; before there was SIFT alone.
    """
    if not hasattr(pycolmap, "FeatureExtractionOptions"):
        return "SIFT"
    kinds = (pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions())
    names = [kind.type.name if hasattr(kind, "type") else "SIFT" for kind in kinds]
    return " matched by ".join(dict.fromkeys(names))


def _file(index: int) -> str:
    return f"{index:06d}.png"
