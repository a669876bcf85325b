"""The files of a map in the dive folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch

from aquaflow.dive.map_file import write_map_file
from aquaflow.dive.ply import PlyGaussians, write_ply
from aquaflow.dive.results import WaterSummary
from aquaflow.dive.water_summary import water_of
from aquaflow.mapping.clear_colours import restored_gaussians
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.activation import radiance
from aquaflow.render.transfers import map_out
from aquaflow.telemetry.world_frame import WorldFrame


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
