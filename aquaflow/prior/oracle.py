"""A stand-in for a good network: it looks the pictures of one dive up, and what is true of them.

It shows what a prior is worth that knows ranges to a stated error and distinguishes all places,
without any that does (docs/prior.md#oracle). Its descriptors are random Fourier features of the
point that a cell shows: their product is the nearer to 1, the nearer two points are.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError, reason_of
from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.contract import Float, RangeUnit
from aquaflow.prior.folder import PriorCard, read_card, sha256_of, write_card
from aquaflow.prior.network import Half, LearnedRange, Picture

TRUTH = "truth.npz"
"""File of the folder: pictures by their checksum, and what each cell shows."""
MOST_CELLS = 2100
"""Of a picture: as many as its descriptors are compared with in a blink."""
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


def write_oracle(
    folder: Path,
    views: list[TrueView],
    camera: CameraModel,
    range_sigma: float,
    seed: int = 0,
) -> PriorCard:
    """An oracle of these pictures; ranges get a relative error of ``range_sigma``, by cells.

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
    cell = float(np.nanmedian(np.exp(log_range))) * cell_px / camera.fx
    np.savez(
        folder / TRUTH,
        pictures=np.array([_checksum(view.picture) for view in views]),
        points=points,
        log_range=log_range.astype(np.float32),
        width=np.float64(WIDTH_CELLS * cell),
        range_sigma=np.float64(range_sigma),
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


class OracleDescriber:
    """Looks pictures up; of one that it does not know, it says nothing."""

    name, metric, describes = "oracle", False, True
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
        except (KeyError, ValueError, OSError) as error:
            raise InputError(
                f"{folder / TRUTH} cannot be read ({reason_of(error)}); write the oracle again"
            ) from error
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
        """[h, w, FEATURES + 1] the descriptors, 0 where nothing is known, and the log of range."""
        number = self._index.get(_checksum(picture))
        if number is None:
            return np.full((*self._points.shape[1:3], FEATURES + 1), np.nan, np.float16)
        phase = self._points[number] @ self._directions + self._phases
        waves = np.concatenate([np.cos(phase), np.sin(phase)], -1) * (2.0 / FEATURES) ** 0.5
        return np.concatenate([waves, self._log_range[number][..., None]], -1).astype(np.float16)

    def compare(
        self,
        a: Half,  # [h, w, FEATURES + 1]
        b: Half,  # [h, w, FEATURES + 1]
        camera_a: CameraModel,
        camera_b: CameraModel,
    ) -> OraclePair:
        """What is known of both."""
        return OraclePair(a.astype(np.float32), b.astype(np.float32), self._variance)


@dataclass(frozen=True)
class OraclePair:
    """Two pictures that were looked up."""

    a: Float
    """[h, w, FEATURES + 1]"""
    b: Float
    """[h, w, FEATURES + 1]"""
    variance: float

    @property
    def cells(self) -> tuple[Float, Float]:
        return np.nan_to_num(self.a[..., :FEATURES]), np.nan_to_num(self.b[..., :FEATURES])

    @property
    def range_a(self) -> LearnedRange:
        return self._range(self.a)

    @property
    def range_b(self) -> LearnedRange:
        return self._range(self.b)

    @property
    def confidence(self) -> Float | None:
        return None

    def _range(
        self,
        found: Float,  # [h, w, FEATURES + 1]
    ) -> LearnedRange:
        log_range = found[..., FEATURES]
        return LearnedRange(log_range, np.full_like(log_range, max(self.variance, 1e-6)))


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
