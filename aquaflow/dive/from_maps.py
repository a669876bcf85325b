"""What a dive takes from its maps: the one door of this folder to code that loads torch.

A function loads what it needs when it is called, with a map in its hands, so that a dive without a
map never does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from aquaflow.base.clocks.wall import Deadline
from aquaflow.dive.held_out_example import HeldOut
from aquaflow.dive.results import WaterSummary
from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.world_frame import WorldFrame

if TYPE_CHECKING:
    from aquaflow.mapping.mapper import Mapper
    from aquaflow.slam import Slam


def water_in_numbers(mapper: Mapper, most_views: int | None = None) -> WaterSummary | None:
    """See :func:`aquaflow.dive.map_file.summarise_water`; None: as many views as there."""
    from aquaflow.dive import map_file

    return map_file.summarise_water(mapper, most_views or map_file.RANGE_VIEWS)


def place_in_daylight(mapper: Mapper, rows: Sequence[PoseRow], sub_map: int) -> str | None:
    """See :func:`aquaflow.dive.white_balance.place_in_daylight`."""
    from aquaflow.dive import white_balance

    return white_balance.place_in_daylight(mapper, rows, sub_map)


def held_out_examples(
    slam: Slam, sub_map: int, poses: Mapping[int, Sim3], until: Deadline | None = None
) -> list[HeldOut]:
    """See :func:`aquaflow.dive.held_out.examine_held_out`; a sub-map without a map has none."""
    if sub_map not in slam.mappers:
        return []
    from aquaflow.dive.held_out import examine_held_out

    return examine_held_out(slam, sub_map, poses, until)


def write_exact(folder: Path, mapper: Mapper, suffix: str = "") -> None:
    """See :func:`aquaflow.dive.map_file.write_exact`."""
    from aquaflow.dive import map_file

    map_file.write_exact(folder, mapper, suffix)


def write_splats(
    folder: Path, mapper: Mapper, water: WaterSummary | None, frame: WorldFrame, suffix: str = ""
) -> None:
    """See :func:`aquaflow.dive.map_file.write_splats`."""
    from aquaflow.dive import map_file

    map_file.write_splats(folder, mapper, water, frame, suffix)


def attenuations(mappers: Mapping[int, Mapper]) -> dict[int, list[float]]:
    """See :func:`aquaflow.dive.map_file.attenuations`; without a map none."""
    if not mappers:
        return {}
    from aquaflow.dive import map_file

    return map_file.attenuations(mappers)
