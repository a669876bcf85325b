"""A stand-in for a good network: it looks the pictures of one dive up, and what is true of them.

It shows what a prior is worth that knows ranges to a stated error and distinguishes all places,
without any that does (docs/prior.md#oracle). Its descriptors are random Fourier features of the
point that a cell shows: their product is the nearer to 1, the nearer two points are.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError, reason_of
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.prior.contract import Float, RangeUnit
from aquaflow.prior.dense_matching import DenseViews
from aquaflow.prior.dense_oracle import DenseOracle
from aquaflow.prior.folder import PriorCard, read_card, sha256_of, write_card
from aquaflow.prior.network import Described, Half, LearnedRange, Picture

TRUTH = "truth.npz"
"""File of the folder: pictures by their checksum, and what each cell shows."""
MOST_CELLS = 2100
"""Of a picture: as many as its descriptors are compared with in a blink."""
PAGE = 1024
"""A picture's number is kept as that of its page and its place there: half floats hold both."""
FEATURES = 64
"""Numbers of a descriptor."""
WIDTH_CELLS = 1.5
"""Distance of two points, in cells at the median range, at which the product of their descriptors
is e^-1/2."""
SEED = 5
"""Of the directions that points are described along."""


@dataclass(frozen=True)
class TrueView:
    """A picture, and the points that its pixels show."""

    picture: Picture
    """[H, W, 3] as tracking gets it"""
    points: npt.NDArray[np.float64]
    """[H, W, 3] in one frame of the whole dive; NaN where nothing is known"""
    ranges: npt.NDArray[np.float64]
    """[H, W] along the pixel's ray, in the unit of ``points``; NaN where nothing is known"""
    T_wc: Sim3
    """Of the camera, in the frame of ``points``"""


def write_oracle(
    folder: Path,
    views: list[TrueView],
    camera: CameraModel,
    range_sigma: float,
    seed: int = 0,
    dense: bool = False,
) -> PriorCard:
    """An oracle of these pictures; ranges get a relative error of ``range_sigma``, by cells. A
    ``dense`` one has points and descriptors of all pixels, too (aquaflow/prior/dense_oracle.py).

    Raises:
        InputError: there is no picture, or ``folder`` holds something.
    """
    if not views:
        raise InputError("there is no picture with a true range; give a dive that has them")
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder} is not empty; give a new folder")
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    cell_px = _cell_px(camera)
    found = [_nearest(view, cell_px) for view in views]
    points = np.stack([points for points, _ in found]).astype(np.float32)
    log_range = np.log(np.stack([ranges for _, ranges in found]))
    log_range = log_range + range_sigma * rng.normal(size=log_range.shape)
    pixel = float(np.nanmedian(np.exp(log_range))) / camera.fx
    np.savez(
        folder / TRUTH,
        pictures=np.array([_checksum(view.picture) for view in views]),
        points=points,
        log_range=log_range.astype(np.float32),
        pixel=np.float64(pixel),
        width=np.float64(WIDTH_CELLS * cell_px * pixel),
        range_sigma=np.float64(range_sigma),
        **(_all_pixels(views) if dense else {}),
    )
    card = PriorCard(
        name="oracle",
        width=camera.width,
        height=camera.height,
        descriptor=FEATURES,
        metric=False,
        licence="no network: true ranges of one dive",
        opset=0,
        files={TRUTH: sha256_of(folder / TRUTH)},
        parity={},
    )
    write_card(folder, card)
    return card


def _all_pixels(views: list[TrueView]) -> dict[str, Any]:
    return {
        "all_points": np.stack([view.points for view in views]).astype(np.float32),
        "R_wc": np.stack([view.T_wc.R for view in views]),
        "centres": np.stack([view.T_wc.t for view in views]),
    }


class OracleDescriber:
    """Looks pictures up; of one that it does not know, it says nothing."""

    name, metric = "oracle", False
    range_unit: RangeUnit = "shared"
    unit_sigma = 0.0
    """Its unit is the same in all pictures."""

    def __init__(self, folder: Path) -> None:
        """Load what :func:`write_oracle` wrote.

        Raises:
            InputError: the folder was not written by it, or was changed.
        """
        read_card(folder)
        try:
            with np.load(folder / TRUTH, allow_pickle=False) as stored:
                found = {key: stored[key] for key in stored.files}
            pictures, self._points = found["pictures"], found["points"]
            self._log_range, self._width = found["log_range"], float(found["width"])
            self._variance = float(found["range_sigma"]) ** 2
            self._dense = _dense_oracle(found) if "all_points" in found else None
        except (KeyError, ValueError, OSError) as error:
            raise InputError(
                f"{folder / TRUTH} cannot be read ({reason_of(error)}); write the oracle again"
            ) from error
        self.describes: Described = "cells" if self._dense is None else "pixels"
        self._index = {str(name): number for number, name in enumerate(pictures)}
        rng = np.random.default_rng(SEED)
        self._directions = rng.normal(size=(3, FEATURES // 2)) / self._width
        self._phases = rng.uniform(0.0, 2.0 * np.pi, FEATURES // 2)

    def fit(
        self,
        image: Picture,  # [H, W, 3]
    ) -> Picture:
        """The picture as it is."""
        return image

    def features(
        self,
        picture: Picture,  # [H, W, 3]
    ) -> Half:
        """[2] the picture's number; NaN of one that is not known."""
        number = self._index.get(_checksum(picture))
        found = (np.nan, np.nan) if number is None else divmod(number, PAGE)
        return np.array(found, np.float16)

    def compare(
        self,
        a: Half,  # [2]
        b: Half,  # [2]
        camera_a: CameraModel,
        camera_b: CameraModel,
    ) -> OraclePair:
        """What is known of both."""
        return OraclePair(self, _number(a), _number(b))

    def descriptors(self, number: int | None) -> Float:
        """[h, w, FEATURES] of the cells of a picture; 0 where nothing is known."""
        if number is None:
            return np.zeros((*self._points.shape[1:3], FEATURES), np.float32)
        phase = self._points[number] @ self._directions + self._phases
        waves = np.concatenate([np.cos(phase), np.sin(phase)], -1) * (2.0 / FEATURES) ** 0.5
        return np.asarray(np.nan_to_num(waves), dtype=np.float32)

    def learned_range(self, number: int | None) -> LearnedRange:
        """Of the cells of a picture."""
        shape = self._points.shape[1:3]
        log_range = np.full(shape, np.nan) if number is None else self._log_range[number]
        variance = np.full(shape, max(self._variance, 1e-6), np.float32)
        return LearnedRange(log_range.astype(np.float32), variance)

    def views(self, a: int | None, b: int | None) -> DenseViews | None:
        """Of all pixels of two pictures; None of an oracle that does not know them."""
        return None if self._dense is None or a is None or b is None else self._dense.views(a, b)


@dataclass(frozen=True)
class OraclePair:
    """Two pictures that were looked up."""

    describer: OracleDescriber
    a: int | None
    b: int | None
    """Their numbers; None of a picture that is not known."""

    @property
    def cells(self) -> tuple[Float, Float]:
        return self.describer.descriptors(self.a), self.describer.descriptors(self.b)

    def dense(self, back: bool = False) -> DenseViews | None:
        """What a dense one knows of both pictures."""
        a, b = (self.b, self.a) if back else (self.a, self.b)
        return self.describer.views(a, b)

    @property
    def range_a(self) -> LearnedRange:
        return self.describer.learned_range(self.a)

    @property
    def range_b(self) -> LearnedRange:
        return self.describer.learned_range(self.b)

    @property
    def confidence(self) -> Float | None:
        return None


def _number(
    features: Half,  # [2]
) -> int | None:
    page, place = features
    return None if np.isnan(page) else PAGE * int(page) + int(place)


def _dense_oracle(
    found: dict[str, npt.NDArray[np.float32]],  # of TRUTH
) -> DenseOracle:
    poses = [Sim3(R, t) for R, t in zip(found["R_wc"], found["centres"], strict=True)]
    sigma, pixel = float(found["range_sigma"]), float(found["pixel"])
    return DenseOracle(found["all_points"], poses, sigma, pixel)


def _cell_px(camera: CameraModel) -> int:
    """Side of a cell: a power of two that divides the picture into at most MOST_CELLS."""
    side = (camera.width * camera.height / MOST_CELLS) ** 0.5
    return int(2 ** np.ceil(np.log2(max(side, 1.0))))


def _nearest(
    view: TrueView,
    cell_px: int,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Points [h, w, 3] and ranges [h, w] of the nearest thing in each cell: of a net, its twine."""
    height, width = view.ranges.shape
    rows, columns = -(-height // cell_px), -(-width // cell_px)
    out = ((0, rows * cell_px - height), (0, columns * cell_px - width))
    ranges = np.pad(view.ranges, out, constant_values=np.nan)
    points = np.pad(view.points, (*out, (0, 0)), constant_values=np.nan)
    ranges = _by_cell(ranges[..., None], rows, columns, cell_px)[..., 0]
    points = _by_cell(points, rows, columns, cell_px)
    first = np.argmin(np.where(np.isfinite(ranges), ranges, np.inf), axis=-1)
    at = first[..., None]
    return (
        np.take_along_axis(points, at[..., None], axis=2)[:, :, 0],
        np.take_along_axis(ranges, at, axis=-1)[..., 0],
    )


def _by_cell(
    values: npt.NDArray[np.float64],  # [rows * cell_px, columns * cell_px, d]
    rows: int,
    columns: int,
    cell_px: int,
) -> npt.NDArray[np.float64]:
    """[rows, columns, cell_px^2, d]"""
    split = values.reshape(rows, cell_px, columns, cell_px, -1).swapaxes(1, 2)
    return split.reshape(rows, columns, cell_px * cell_px, -1)


def _checksum(
    picture: Picture,  # [H, W, 3]
) -> str:
    return hashlib.sha256(np.ascontiguousarray(picture).tobytes()).hexdigest()
