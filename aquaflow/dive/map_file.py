"""``map.aqf``: the exact map; a map that is read renders bit for bit like the one written.

A file of arrays and facts (:mod:`aquaflow.base.storage.archive`), as
:mod:`aquaflow.mapping.state` serialises a map. PLY files show one choice of range or
viewpoint; this file has the water, the light of every view and the decoder itself.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.base.errors import AquaFlowError, DamagedError, InputError, reason_of
from aquaflow.base.storage.archive import (
    UNREADABLE,
    Arrays,
    read_facts_file,
    write_facts_file,
)
from aquaflow.dive.ply import PlyGaussians, write_ply
from aquaflow.dive.results import WaterSummary
from aquaflow.mapping.appearance import shown_tone
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import restored_gaussians
from aquaflow.mapping.state import VIEWS, Facts, deserialise, deserialise_views, serialise
from aquaflow.render.contract import CPU, Renderer, radiance
from aquaflow.render.transfers import map_out, picture_out, water_in, water_out
from aquaflow.render.views import View
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.water.medium import WaterParameters
from aquaflow.water.sightings import SOLID
from aquaflow.water.white_balance import ChosenWhite

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
    facts, arrays = _read(path)
    with _naming(path):
        return deserialise(facts, arrays, renderer)


def read_map_views(path: Path) -> list[View]:
    """The views of a map in its order, without pictures; nothing of its Gaussians is read.

    Raises:
        InputError: the file is not there, damaged, not an AquaFlow map, or of a newer AquaFlow.
    """
    facts, arrays = _read(path, only=VIEWS)
    with _naming(path):
        return deserialise_views(facts, arrays)


def _read(path: Path, only: str = "") -> tuple[Facts, Arrays]:
    """The facts of a map, and those of its arrays whose names begin with ``only``."""
    try:
        facts, arrays = read_facts_file(path, only=only)
        if facts["kind"] != KIND:
            raise DamagedError("it says that it is something else")
    except UNREADABLE as error:
        raise InputError(_unreadable(path, error)) from error
    if facts["format"] != FORMAT:
        raise InputError(
            f"the map {path} has format {facts['format']}, this AquaFlow reads format {FORMAT}; "
            "update AquaFlow"
        )
    return facts, arrays


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Whatever damage raises is an InputError that names the file."""
    try:
        yield
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
        J = radiance(plain["raw_colours"])
        seen = clear = map_out(J)
        if water is not None:
            medium = water_of(water, J.device)
            z = torch.full((len(J),), water.range_median, device=J.device)
            seen = map_out(J * medium.transmission(z) + medium.backscatter(z))
            clear = _as_shown(mapper, J)
        for name, colours in (("map", seen), ("map_clear", clear)):
            write_ply(folder / f"{name}{suffix}.ply", _place(_splats(plain, colours), frame))


def clear_splats(mapper: Mapper, frame: WorldFrame) -> PlyGaussians:
    """All Gaussians in ``frame``, without water, in the colours that are shown of the map."""
    with torch.no_grad():
        plain = mapper.scene.bake_parameters(mapper.views)
        colours = _as_shown(mapper, radiance(plain["raw_colours"]))
    return _place(_splats(plain, colours), frame)


def _place(splats: PlyGaussians, frame: WorldFrame) -> PlyGaussians:
    return splats if frame.is_identity else splats.transform(frame.T_nm)


@torch.no_grad()
def _as_shown(
    mapper: Mapper,
    J: torch.Tensor,  # [N, 3] of the Gaussians
) -> npt.NDArray[np.float32]:
    """[N, 3] without water, in the white balance and tone of the map."""
    tone = shown_tone(mapper)
    clear = restored_gaussians(mapper.scene, J, mapper.views)
    return tone.of(map_out(clear)).astype(np.float32)


def _splats(
    parameters: Mapping[str, torch.Tensor],  # of a GaussianMap
    colours: npt.NDArray[np.float32],  # [N, 3]
) -> PlyGaussians:
    return PlyGaussians(
        map_out(parameters["means"]),
        map_out(torch.nn.functional.normalize(parameters["quats"], dim=-1)),
        map_out(torch.exp(parameters["log_scales"])),
        map_out(torch.sigmoid(parameters["opacity_logits"][:, 0])),
        colours,
    )


# --------------------------------------------------------------------------------------------------
# The Gaussians of a map as they leave it: plain, in numpy.


@torch.no_grad()
def splats_of(mapper: Mapper) -> PlyGaussians:
    """Copies of all Gaussians in the map's frame and unit, in colours without water.

    With a decoder, each Gaussian as the mapped view nearest to it sees it.
    """
    plain = mapper.scene.bake_parameters(mapper.views)
    return _splats(plain, map_out(radiance(plain["raw_colours"])))


# --------------------------------------------------------------------------------------------------
# The water of a finished sub-map in numbers, from its map.

RANGE_PERCENTILES = (5.0, 95.0)
"""Percent; values outside are single pixels at edges of the map."""
RANGE_VIEWS = 100
"""Most views that the span of ranges is taken from."""


@torch.no_grad()
def summarise_water(mapper: Mapper, most_views: int = RANGE_VIEWS) -> WaterSummary | None:
    """Mean medium over the views and the ranges they span; None while the medium is off."""
    if not mapper.medium.active or not mapper.views or len(mapper.gaussians) == 0:
        return None
    waters = [water for view in mapper.views if (water := mapper.scene.water(view)) is not None]
    looked_at = mapper.views[:: _step(mapper, most_views)]
    z = torch.cat([_solid_ranges(mapper, view) for view in looked_at])
    if len(z) == 0:
        return None
    low, high = np.percentile(picture_out(z), RANGE_PERCENTILES)
    first, tone, balance = waters[0], shown_tone(mapper), mapper.scene.balance
    chosen = ChosenWhite() if balance is None else balance.chosen
    summary = WaterSummary(
        water_out(torch.stack([water.beta_a for water in waters]).mean(0)).tolist(),
        water_out(first.b).tolist(),
        water_out(first.B_inf).tolist(),
        water_out(first.B_res).tolist(),
        water_out(first.d).tolist(),
        float(low),
        float(z.median()),
        float(high),
        water_out(mapper.scene.white_gain()).tolist(),
        chosen.name,
        list(chosen.gain),
        None if chosen.sigma is None else list(chosen.sigma),
        None if balance is None else balance.near_range,
        mapper.scene.range_variance,
        mapper.scene.lightness_over_range,
        mapper.scene.beta_a_sigma,
        mapper.scene.shading.tolist(),
        mapper.scene.unevenness().tolist(),
        mapper.scene.lamp,
        tone.exposure,
        tone.compression,
    )
    numbers = (low, high, summary.range_median, *summary.beta_a, *summary.B_inf, *summary.b)
    if not np.isfinite(numbers).all():
        raise ArithmeticError("the water's summary is not finite")
    return summary


def attenuations(mappers: Mapping[int, Mapper]) -> dict[int, list[float]]:
    """Per map unit, of each channel, by sub-map; without water none. In the maps' thread."""
    found = {}
    for number, mapper in mappers.items():
        water = mapper.scene.water(mapper.views[-1]) if mapper.views else None
        if water is not None:
            found[number] = water_out(water.beta_a).ravel().tolist()
    return found


def _step(mapper: Mapper, most: int) -> int:
    """Every tenth view is enough for the span of ranges."""
    return max(10, -(-len(mapper.views) // most))


def _solid_ranges(mapper: Mapper, view: View) -> torch.Tensor:
    shown = mapper.show(view)
    return shown.z[shown.alpha > SOLID]


def water_of(summary: WaterSummary, device: torch.device = CPU) -> WaterParameters:
    """The summary as tensors."""
    fields = (summary.beta_a, summary.B_inf, summary.b, summary.B_res, summary.d)
    beta_a, B_inf, b, B_res, d = (water_in(values, device) for values in fields)
    return WaterParameters(beta_a, B_inf, b, B_res, d, summary.lamp)
