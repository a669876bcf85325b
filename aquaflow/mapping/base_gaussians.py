"""Gaussians of an earlier dive's map, the start of this dive's where both see the same ground.

They wait outside the map. A keyframe takes those over that lie where its own ranges put a surface
and its map has none yet: what was moved away since never enters, and nothing is there twice. From
then on they are this dive's, tied to the keyframe, optimised in its water and its light.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from aquaflow.base.errors import DamagedError
from aquaflow.base.errors.failures import Failures
from aquaflow.base.storage.archive import read_facts_file
from aquaflow.geometry.arrays import Arrays
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.gaussians import GaussianMap, move_gaussians, raw_colour
from aquaflow.mapping.spatial_index import SpatialIndex
from aquaflow.render.views import View

Float = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]

SAME_RANGE = 0.05
"""Relative difference of ranges up to which a Gaussian lies on the surface that a keyframe tracked:
two dives' places and scales differ by up to 2 % (notes/2026-11-sites.md#merge), fused depths by as
much."""
RIM_PX = 2
"""Distance to an edge of depth within which either side is believed: two pixels of the smallest
pictures that are mapped."""
OPAQUE = 0.5
"""Opacity from which a Gaussian's colour is compared with the picture's."""
DARKEST = 0.02
"""Colours below are rounded too coarsely to be compared."""
LEAST_COLOURS = 100
"""From which a gain is taken: fewer could be one thing that changed its colour."""


class BaseGaussians:
    """The Gaussians of one map file that no keyframe of this dive has taken over yet."""

    def __init__(
        self,
        parameters: Mapping[str, Tensor],  # of a GaussianMap, in the file's world b
    ) -> None:
        self._parameters = dict(parameters)
        means = parameters["means"].numpy()
        largest = parameters["log_scales"].amax(dim=1).exp().numpy()
        self._index = SpatialIndex(means, largest) if len(means) else None
        sound = [torch.isfinite(tensor).all(dim=1) for tensor in parameters.values()]
        self.waiting: Mask = torch.stack(sound).all(dim=0).numpy()
        """[N] False for those that were taken over, that the map has already, or that are not
        finite."""
        self.taken = 0
        """Those that were taken over."""
        self._log_gain = torch.zeros(3)
        """Of this dive's light over the earlier one's, as last compared."""

    def on_surface(
        self,
        view: View,
        T_mb: Sim3,
        z: Tensor,  # [H, W] range as tracked, map units; 0 where unknown
    ) -> OnSurface | None:
        """Those that wait and lie where ``view`` tracked a surface; None where there are none."""
        if self._index is None:
            return None
        T_bm = T_mb.inverse()
        camera_in_b = Sim3(T_bm.R @ view.T_wc.R, T_bm.apply(view.T_wc.t))
        numbers = self._index.in_picture(view.camera, camera_in_b)
        numbers = numbers[self.waiting[numbers]]
        means = T_mb.apply(self._parameters["means"].numpy()[numbers].astype(np.float64))
        local = (means - view.T_wc.t) @ view.T_wc.R
        ahead = local[:, 2] > 0.0
        numbers, local = numbers[ahead], local[ahead]
        pixels = np.floor(view.camera.project(local)).astype(np.int64)
        size = np.array([view.camera.width, view.camera.height])
        inside = ((pixels >= 0) & (pixels < size)).all(axis=1)
        numbers, local, (columns, rows) = numbers[inside], local[inside], pixels[inside].T
        ranges = np.linalg.norm(local, axis=1)
        nearest, farthest = (each.numpy()[rows, columns] for each in _around(z))
        there = ranges >= nearest * (1.0 - SAME_RANGE)
        there &= ranges <= farthest * (1.0 + SAME_RANGE)
        return OnSurface(numbers[there], rows[there], columns[there]) if there.any() else None

    def take(
        self,
        found: OnSurface,
        T_mb: Sim3,
        J: Float,  # [H, W, 3] the view's picture without water
        recoverable: Mask,  # [H, W]
    ) -> dict[str, Tensor]:
        """The Gaussians ``found`` as those of this dive's map, each [M, ...], in its light; they no
        longer wait."""
        taken = GaussianMap()
        taken.extend({n: t[found.numbers] for n, t in self._parameters.items()}, keyframe=0)
        move_gaussians(taken, {0: T_mb})
        colours, theirs = taken.colours, torch.from_numpy(J[found.rows, found.columns])
        usable = (taken.opacities > OPAQUE).numpy() & recoverable[found.rows, found.columns]
        lit = (colours > DARKEST) & (theirs > DARKEST) & torch.from_numpy(usable)[:, None]
        if int(lit.all(dim=1).sum()) >= LEAST_COLOURS:
            ratio = theirs.clamp_min(DARKEST).log() - colours.clamp_min(DARKEST).log()
            self._log_gain = torch.where(lit, ratio, torch.nan).nanmedian(dim=0).values
        self.leave(found)
        self.taken += len(found.numbers)
        return {**taken.parameters, "raw_colours": raw_colour(colours * self._log_gain.exp())}

    def leave(self, found: OnSurface) -> None:
        """These no longer wait."""
        self.waiting[found.numbers] = False


@dataclass(frozen=True)
class OnSurface:
    """M Gaussians that wait, on the surface that a view tracked."""

    numbers: Rows
    """[M] in their map file."""
    rows: Rows
    """[M] of the view's pixels that show them."""
    columns: Rows

    def only(
        self,
        which: npt.NDArray[Any],  # [M] bool, or numbers
    ) -> OnSurface:
        """Some of them."""
        return OnSurface(self.numbers[which], self.rows[which], self.columns[which])


def _around(
    z: Tensor,  # [H, W] 0 where unknown
) -> tuple[Tensor, Tensor]:
    """[H, W], [H, W] the least and the largest range around each pixel; inf and 0 where none is
    known."""
    side = 2 * RIM_PX + 1

    def largest(values: Tensor) -> Tensor:
        return F.max_pool2d(values[None], side, stride=1, padding=RIM_PX)[0]

    inverse = torch.where(z > 0.0, 1.0 / z.clamp_min(1e-6), 0.0)
    return 1.0 / largest(inverse), largest(z)


# --------------------------------------------------------------------------------------------------
# The map files of the base, each read when the dive was first recognised in what it shows.

PREFIX = "gaussians."
"""Of their names in a map file (mapping/state.py)."""
STAGE = "map of the base"
"""Name of reading them."""


class BaseMaps:
    """The base's maps by file; what was taken over is so for the whole dive."""

    def __init__(self, failures: Failures) -> None:
        """A file that cannot be read is counted in ``failures``, once, and nothing comes of it."""
        self._failures = failures
        self._maps: dict[Path, BaseGaussians] = {}
        self._restored: dict[Path, tuple[Mask, int]] = {}

    @property
    def taken(self) -> int:
        """Gaussians that were taken over."""
        restored = sum(taken for _, taken in self._restored.values())
        return restored + sum(each.taken for each in self._maps.values())

    def placed(self, where: Mapping[Path, Sim3]) -> list[tuple[BaseGaussians, Sim3]]:
        """The Gaussians of the files ``where`` T_mb says how they lie in a sub-map's world."""
        for path in where.keys() - self._maps.keys():
            parameters = {name: torch.zeros(0, width) for name, width in GaussianMap.WIDTHS.items()}
            with self._failures.contain(STAGE):
                parameters = read_gaussians(path)
            self._maps[path] = gaussians = BaseGaussians(parameters)
            waiting, taken = self._restored.pop(path, (gaussians.waiting, 0))
            gaussians.taken = taken
            if len(waiting) == len(gaussians.waiting):  # else it is another map since
                gaussians.waiting = waiting
        return [(self._maps[path], T_mb) for path, T_mb in where.items()]

    def serialise(self) -> tuple[dict[str, int], Arrays]:
        """By path how many were taken over; and which wait, in the order of the paths."""
        known = {path: (each.waiting.copy(), each.taken) for path, each in self._maps.items()}
        known |= self._restored
        arrays = {f"waiting{i}": waiting for i, (waiting, _) in enumerate(known.values())}
        return {str(path): taken for path, (_, taken) in known.items()}, arrays

    def restore(
        self,
        facts: Mapping[str, int],
        arrays: Arrays,  # as from serialise
    ) -> None:
        """Take up what a checkpoint has of them."""
        for i, (path, taken) in enumerate(facts.items()):
            self._restored[Path(path)] = np.array(arrays[f"waiting{i}"], bool), int(taken)


def read_gaussians(path: Path) -> dict[str, Tensor]:
    """The parameters of a map file's Gaussians, by the names of a GaussianMap.

    Raises:
        UNREADABLE: the file is not there, damaged, or no map (base/storage/archive.py).
        KeyError, DamagedError: it lacks some.
    """
    _, arrays = read_facts_file(path, only=PREFIX)
    found = {
        name: torch.from_numpy(np.array(arrays[PREFIX + name], np.float32)).reshape(-1, width)
        for name, width in GaussianMap.WIDTHS.items()
    }
    if len({len(tensor) for tensor in found.values()}) > 1:
        raise DamagedError("its Gaussians differ in number")
    return found
