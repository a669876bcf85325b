"""Coverage of a finished dive's Gaussians: by its own plan, else by where its keyframes were."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.config import load_config
from aquaflow.config.coverage import CoverageConfig
from aquaflow.coverage.coverage_file import NAME, read_coverage_file
from aquaflow.coverage.water_range import mapping_range
from aquaflow.errors import AquaFlowError, InputError
from aquaflow.fusion.metric_file import read_main
from aquaflow.fusion.metric_frame import MetricFrame
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.viewer.seen_classes import Levels, coverage_level
from aquaflow.viewer.seen_water import SeenWater

log = logging.getLogger(__name__)


def coverage_of_dive(
    folder: Path,
    centres: npt.NDArray[np.floating],  # [N, 3] in n
    keyframes: list[Sim3],  # T_nc
    camera: CameraModel,
    frame: MetricFrame,
    water: SeenWater | None,
) -> Levels | None:
    """[N] a :class:`aquaflow.coverage.Seen` for each; None where nothing is known."""
    if (folder / NAME).is_file():
        try:
            view = read_coverage_file(folder / NAME).get(read_main(folder))
        except InputError as error:
            log.warning("the viewer takes the coverage from the keyframes' poses: %s", error)
        else:
            if view is not None:
                T_mn = frame.T_nm.inverse()
                return view.plan.classes_of(T_mn.apply(np.nan_to_num(centres).astype(np.float64)))
    if not keyframes:
        return None
    config = _config(folder)
    up = np.array([0.0, 0.0, -1.0] if frame.level else [0.0, -1.0, 0.0])
    limit = None if water is None else mapping_range(water.beta, config.least_contrast)
    return coverage_level(centres, keyframes, camera, up, limit, config)


def _config(folder: Path) -> CoverageConfig:
    """The dive's own settings, else the usual ones."""
    try:
        return load_config(folder / "config.yaml").coverage
    except AquaFlowError:  # of another version, which shows the same map
        return CoverageConfig()
