"""The white balance that the restored colours of a finished dive are shown in, chosen anew."""

from __future__ import annotations

import math
from typing import Literal, cast

import numpy as np
import torch

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.restored import refuse_outside, refuse_without_water, view_of_frame
from aquaflow.mapping.appearance import Grey, choose
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import restored_own, was_restored
from aquaflow.render.transfers import picture_out
from aquaflow.water.white_balance import CAMERA, NEUTRAL

PATCH_PX = 2
"""On each side of the pixel that is said to be grey: a patch of a colour chart has 6 px or more in
the shared clips."""
DARK = 0.02
"""Of a channel's full scale: what is darker has no colour."""


def show_in(dive: Dive, choice: str) -> None:
    """Show all restored colours of the dive's largest sub-map in a white balance from now on: that
    of the camera for what was nearest (``camera``), one in which the light of the restored scene is
    grey (``neutral``), or one in which a pixel of a mapped picture is (``FRAME:X,Y``). Its files
    stay as they are.

    Raises:
        InputError: it is no white balance, there is no such pixel, the map shows nothing there, or
            has no water.
        ConfigError: the dive's settings cannot be read.
    """
    place = None if choice in (CAMERA, NEUTRAL) else _place(choice)
    mapper = dive.filled_map()
    refuse_without_water(dive, mapper)
    if mapper.scene.balance is None:
        raise InputError(
            f"the water of {dive} was never fitted, so its colours have one white balance only; "
            "leave --white-balance out"
        )
    if place is None:
        choose(mapper, cast(Literal["camera", "neutral"], choice))
        if mapper.scene.balance.chosen.name != choice:
            raise InputError(
                f"too little of {dive} was restored to say what is neutral; name something grey as "
                "FRAME:X,Y"
            )
    else:
        choose(mapper, _grey(dive, mapper, choice, *place))
    dive.white_balance = choice


def _place(text: str) -> tuple[int, float, float]:
    """Frame and pixel."""
    try:
        frame, _, pixel = text.partition(":")
        x, y = (float(part) for part in pixel.split(","))
        if math.isfinite(x) and math.isfinite(y):
            return int(frame), x, y
    except ValueError:
        pass
    raise InputError(
        f"{text[:80]!r} is no white balance; give camera, neutral, or FRAME:X,Y of something grey"
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
