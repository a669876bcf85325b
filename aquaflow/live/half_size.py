"""New views of the map at half the width: a quarter of the pixels to keep and to draw."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from aquaflow.keyframes import Pointmap
from aquaflow.mapping.work import Growth

if TYPE_CHECKING:
    from aquaflow.render.views import View


def halve(growth: Growth) -> Growth:
    """The same growth at half the picture width."""
    view = growth.view
    width, height = view.camera.width // 2, view.camera.height // 2
    small = view.with_pixels(
        _picture(view, width, height),
        view.camera.scaled(width, height),
        None if view.mask is None else view.mask[1 : 2 * height : 2, 1 : 2 * width : 2].copy(),
    )
    pointmap = growth.pointmap
    if pointmap is not None:
        pointmap = _pointmap(pointmap, small)
    return replace(growth, view=small, pointmap=pointmap)


def _picture(view: View, width: int, height: int) -> npt.NDArray[np.uint8]:
    import cv2

    whole = view.image[: 2 * height, : 2 * width]
    small = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def _pointmap(pointmap: Pointmap, small: View) -> Pointmap:
    rows = slice(1, 2 * small.camera.height, 2)
    columns = slice(1, 2 * small.camera.width, 2)
    rho, variance = pointmap.rho[rows, columns], pointmap.variance[rows, columns]
    learned = pointmap.learned
    if learned is not None:
        half_rho, half_variance = learned.rho[rows, columns], learned.variance[rows, columns]
        learned = replace(learned, rho=half_rho, variance=half_variance)
    return Pointmap(small.camera, rho.copy(), variance.copy(), learned=learned)
