"""The white balance that the restored colours of a finished dive are shown in, chosen anew."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import numpy as np
import torch

from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.config.white_balance import CAMERA, DAYLIGHT, NEUTRAL, white_balance_named
from aquaflow.dive.dive import Dive
from aquaflow.dive.restored import refuse_outside, refuse_without_water, view_of_frame
from aquaflow.dive.trajectory_csv import NAME as TRAJECTORY_CSV
from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.mapping.appearance import Grey, choose, doubt_of_daylight
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import restored_own, was_restored
from aquaflow.render.transfers import picture_out
from aquaflow.water.daylight import Depths

log = logging.getLogger(__name__)

PATCH_PX = 2
"""On each side of the pixel that is said to be grey: a patch of a colour chart has 6 px or more in
the shared clips."""
DARK = 0.02
"""Of a channel's full scale: what is darker has no colour."""


def show_in(dive: Dive, choice: str) -> None:
    """Show all restored colours of the dive's largest sub-map in a white balance from now on: that
    of the camera for what was nearest (``camera``), one in which the light of the restored scene is
    grey (``neutral``), or daylight at the dive's depth in its own water (``daylight``) or in that
    of a type of Jerlov's (``daylight:TYPE``), or a pixel of a mapped picture (``FRAME:X,Y``). Its
    files stay as they are. Daylight that the scene itself contradicts is warned of.

    Raises:
        ArgumentError: it is no white balance.
        InputError: there is no such pixel, the map shows nothing there, or has no water, or no
            depth is known of the dive.
        ConfigError: the dive's settings cannot be read.
    """
    name = _name(choice)
    place = _place(choice) if name is None else None
    mapper = dive.filled_map()
    refuse_without_water(dive, mapper)
    if mapper.scene.balance is None:
        raise InputError(
            f"the water of {dive} was never fitted, so its colours have one white balance only; "
            "leave --white-balance out"
        )
    if place is not None:
        choose(mapper, _grey(dive, mapper, choice, *place))
    elif name is not None:
        if name.startswith(DAYLIGHT):
            mapper.depths = _depths(dive)
            if (doubt := doubt_of_daylight(mapper, name)) is not None:
                log.warning("%s", doubt)
        choose(mapper, name)
        if name == NEUTRAL != mapper.scene.balance.chosen.name:
            raise InputError(
                f"too little of {dive} was restored to say what is neutral; name something grey as "
                "FRAME:X,Y"
            )
    dive.white_balance = name or choice


def _name(choice: str) -> str | None:
    try:
        return white_balance_named(choice)
    except ValueError as error:
        raise ArgumentError(str(error)) from error


def depths_below(rows: Sequence[PoseRow], sub_map: int) -> Depths | None:
    """Below the surface, of the poses of a sub-map; None where telemetry had none."""
    known = [row.depth_m for row in rows if row.sub_map == sub_map and row.depth_m is not None]
    return Depths(float(np.mean(known)), float(np.std(known))) if known else None


def place_in_daylight(mapper: Mapper, rows: Sequence[PoseRow], sub_map: int) -> str | None:
    """Let the map of a sub-map know its depths, for daylight that its settings ask for; a sentence
    where that does not serve, or None."""
    mapper.depths, mapper.tone = depths_below(rows, sub_map), None
    wanted = mapper.config.medium.white_balance
    if mapper.scene.balance is None:
        return None
    if mapper.depths is None:
        return (
            "no depth below the surface is known, so restored colours have the camera's white "
            f"balance and not {wanted}; give --telemetry with depth or pressure"
        )
    return doubt_of_daylight(mapper, wanted)


def _depths(dive: Dive) -> Depths:
    found = depths_below(dive.poses, dive.main) if dive.has(TRAJECTORY_CSV) else None
    if found is None:
        raise InputError(
            f"{dive} has no depth below the surface, on which the colour of daylight depends; map "
            f"it with --telemetry and a log of depth or pressure, or choose {NEUTRAL}"
        )
    return found


def _place(text: str) -> tuple[int, float, float]:
    """Frame and pixel."""
    try:
        frame, _, pixel = text.partition(":")
        x, y = (float(part) for part in pixel.split(","))
        if math.isfinite(x) and math.isfinite(y):
            return int(frame), x, y
    except ValueError:
        pass
    raise ArgumentError(
        f"{text[:80]!r} is no white balance; give {CAMERA}, {NEUTRAL}, {DAYLIGHT}, "
        f"{DAYLIGHT}:TYPE (such as {DAYLIGHT}:oceanic_II), or FRAME:X,Y of something grey"
    )


@torch.no_grad()
def _grey(dive: Dive, mapper: Mapper, name: str, frame: int, x: float, y: float) -> Grey:
    view = view_of_frame(mapper, frame, dive)
    refuse_outside(view, np.array([[x, y]]))
    shown = mapper.show(view)
    own = restored_own(mapper.scene, view, shown)
    rows, columns = (slice(max(0, int(at) - PATCH_PX), int(at) + PATCH_PX + 1) for at in (y, x))
    patch = picture_out(was_restored(view, shown, own)[rows, columns])
    if not patch.any():
        raise InputError(
            f"nothing was restored at {x:g},{y:g} of frame {frame}; choose a grey place that is "
            "nearer to the camera"
        )
    assert mapper.scene.balance is not None
    camera = picture_out(own.picture[rows, columns])[patch] / mapper.scene.balance.chosen.gain
    colour = np.median(camera.astype(np.float64), axis=0)
    if colour.min() < DARK:
        raise InputError(
            f"the pixel {x:g},{y:g} of frame {frame} is too dark in a channel to say what is grey; "
            "choose a brighter place"
        )
    z = float(np.median(picture_out(shown.z[rows, columns])[patch]))
    return Grey(name, colour, z, int(patch.sum()))
