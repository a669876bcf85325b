"""``map.aqf``: the exact map; a map that is read renders bit for bit like the one written.

A file of arrays and facts (:mod:`aquaflow.base.storage.archive`), as
:mod:`aquaflow.mapping.state` serialises a map. PLY files show one choice of range or
viewpoint; this file has the water, the light of every view and the decoder itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.base.errors import AquaFlowError, DamagedError, InputError, reason_of
from aquaflow.base.storage.archive import UNREADABLE, read_facts_file, write_facts_file
from aquaflow.dive.ply import PlyGaussians, write_ply
from aquaflow.dive.results import WaterSummary
from aquaflow.dive.water_summary import water_of
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import restored_gaussians
from aquaflow.mapping.state import deserialise, serialise
from aquaflow.render.contract import Renderer, radiance
from aquaflow.render.transfers import map_out
from aquaflow.telemetry.world_frame import WorldFrame

SUFFIX = ".aqf"
"""Of a map file."""
KIND = "aquaflow map"
"""The kind of file, stated in its facts."""
FORMAT = 1
"""Raised whenever an older AquaFlow could no longer read the file."""


def write_map_file(path: Path, mapper: Mapper, optimiser: bool = False) -> None:
    """Write the map, whole or not at all; with ``optimiser`` it may be optimised further.

    Raises:
        InputError: the file cannot be written.
        ArithmeticError: a number of the map is not finite.
    """
    facts, arrays = serialise(mapper, optimiser)
    bad = [name for name, array in arrays.items() if not _is_finite(array)]
    if bad:
        raise ArithmeticError(f"{bad[0]} of the map is not finite")
    write_facts_file(path, {"kind": KIND, "format": FORMAT, **facts}, arrays)


def _is_finite(
    array: npt.NDArray[Any],  # [...]
) -> bool:
    return array.dtype.kind != "f" or bool(np.isfinite(array).all())


def read_map_file(path: Path, renderer: Renderer) -> Mapper:
    """The map, to be drawn by ``renderer``; its views have no pictures.

    Raises:
        InputError: the file is not there, damaged, not an AquaFlow map, or of a newer AquaFlow.
    """
    try:
        facts, arrays = read_facts_file(path)
        if facts["kind"] != KIND:
            raise DamagedError("it says that it is something else")
    except UNREADABLE as error:
        raise InputError(_unreadable(path, error)) from error
    if facts["format"] != FORMAT:
        raise InputError(
            f"the map {path} has format {facts['format']}, this AquaFlow reads format {FORMAT}; "
            "update AquaFlow"
        )
    try:
        return deserialise(facts, arrays, renderer)
    except (KeyError, ValueError, TypeError, RuntimeError, IndexError, AquaFlowError) as error:
        raise InputError(_unreadable(path, error)) from error


def _unreadable(path: Path, error: Exception) -> str:
    if isinstance(error, OSError):
        return f"cannot read the map {path}: {reason_of(error)}; give a map{SUFFIX}"
    return f"{path} is no whole AquaFlow map ({reason_of(error)}); copy or map it again"


# --------------------------------------------------------------------------------------------------
# The files of a map in the dive folder.


def write_exact(folder: Path, mapper: Mapper, suffix: str) -> None:
    """map.aqf: the exact map."""
    write_map_file(folder / f"map{suffix}.aqf", mapper)


def write_splats(
    folder: Path, mapper: Mapper, water: WaterSummary | None, frame: WorldFrame, suffix: str
) -> None:
    """map.ply and map_clear.ply, as :meth:`aquaflow.dive.folder.DiveFolder.write_splats` says."""
    with torch.no_grad():
        plain = mapper.scene.bake_parameters(mapper.views)
        clear = radiance(plain["raw_colours"])
        seen = clear
        if water is not None:
            medium = water_of(water, clear.device)
            z = torch.full((len(clear),), water.range_median, device=clear.device)
            seen = clear * medium.transmission(z) + medium.backscatter(z)
            clear = restored_gaussians(mapper.scene, clear, mapper.views)
        for name, colours in (("map", seen), ("map_clear", clear)):
            splats = _splats(plain, colours)
            if not frame.is_identity:
                splats = splats.transform(frame.T_nm)
            write_ply(folder / f"{name}{suffix}.ply", splats)


def _splats(
    parameters: Mapping[str, torch.Tensor],  # of a GaussianMap
    colours: torch.Tensor,  # [N, 3]
) -> PlyGaussians:
    return PlyGaussians(
        map_out(parameters["means"]),
        map_out(torch.nn.functional.normalize(parameters["quats"], dim=-1)),
        map_out(torch.exp(parameters["log_scales"])),
        map_out(torch.sigmoid(parameters["opacity_logits"][:, 0])),
        map_out(colours),
    )


# --------------------------------------------------------------------------------------------------
# The Gaussians of a map as they leave it: plain, in numpy.


@torch.no_grad()
def splats_of(mapper: Mapper) -> PlyGaussians:
    """Copies of all Gaussians in the map's frame and unit, in colours without water.

    With a decoder, each Gaussian as the mapped view nearest to it sees it.
    """
    plain = mapper.scene.bake_parameters(mapper.views)
    return PlyGaussians(
        means=map_out(plain["means"]),
        wxyz=map_out(torch.nn.functional.normalize(plain["quats"], dim=-1)),
        scales=map_out(torch.exp(plain["log_scales"])),
        opacities=map_out(torch.sigmoid(plain["opacity_logits"][:, 0])),
        colours=map_out(radiance(plain["raw_colours"])),
    )
