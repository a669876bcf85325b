"""How well the water was removed: restored held-out views against the scene without water.

Published methods restore the same views, as a second opinion.

The brightness and white balance of a scene without water are a convention, so one gain per channel,
the same for all frames, is granted to the restored pictures, and to the raw ones that they must
beat. Where open water was removed, neither is compared.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.lab.evaluation.held_out import Kind, held_out_indices, read_picture, read_range
from aquaflow.lab.evaluation.water_peers import contract, sea_thru, udcp
from aquaflow.lab.evaluation.water_peers.contract import (
    NAMES,
    Method,
    NotRestoredError,
    Pictures,
    Ranges,
)
from aquaflow.render.image_metrics import channel_gain, psnr
from aquaflow.sources import open_recording
from aquaflow.sources.preprocessing import Preparation
from aquaflow.types import Frame

SYNTHETIC_MARK = "synth.yaml"
"""The file by which a folder is known to be a synthetic dive."""
SYNTHETIC_CLEAN = "clean"
"""A synthetic dive keeps its pictures without water in this folder."""


@dataclass(frozen=True)
class Restoration:
    """Restored and raw held-out frames against the same frames without water."""

    frames: int
    psnr_restored: float
    """dB, mean over the frames, after one gain per channel for all of them."""
    psnr_raw: float
    """dB, the same for what the camera saw."""
    psnr_peers: dict[str, float]
    """dB, the same for what published methods made of it, by the keys of ``water_peers``."""
    peer_reasons: dict[str, str]
    """Why a method is not among them."""

    def to_json(self) -> dict[str, Any]:
        """Stable keys."""
        return {
            "frames": self.frames,
            "psnr_restored": self.psnr_restored,
            "psnr_raw": self.psnr_raw,
            "gain_db": self.psnr_restored - self.psnr_raw,
            **{f"psnr_{name}": self.psnr_peers.get(name) for name in NAMES},
            "peer_reasons": self.peer_reasons,
        }


def evaluate_restoration(dive: Path, clean: Path, crop: str | None) -> Restoration:
    """Compare the dive's restored held-out frames with a recording of them without water.

    Args:
        dive: the folder that a run wrote.
        clean: a recording with the frames of the one that was mapped, or a synthetic dive.
        crop: the part of ``clean`` that shows the scene; None is all of it.

    Raises:
        InputError: there is nothing to compare, or the pictures do not fit each other.
        ConfigError: the crop does not fit the pictures.
    """
    indices = _held_out(dive)
    reference = clean_pictures(dive, clean, crop, indices)
    raw, _ = _load_stored(dive, indices, "real")
    restored, opaque = _load_stored(dive, indices, "restored")
    if reference.shape != raw.shape:
        raise InputError(
            f"{clean} is {reference.shape[2]} x {reference.shape[1]} once prepared like the dive, "
            f"whose pictures are {raw.shape[2]} x {raw.shape[1]}; choose the --clean-crop that "
            "shows the same view"
        )
    if not opaque.any():
        raise InputError(f"the restored pictures in {dive} show nothing but removed open water")
    ranges = held_out_ranges(dive, indices, (raw.shape[1], raw.shape[2]))
    peers, reasons = {}, {}
    for name, restore in METHODS.items():
        try:
            peers[name] = _mean_psnr(restore(raw, ranges), reference, opaque)
        except NotRestoredError as error:
            reasons[name] = str(error)
    return Restoration(
        len(indices),
        _mean_psnr(restored, reference, opaque),
        _mean_psnr(raw, reference, opaque),
        peers,
        reasons,
    )


def _mean_psnr(
    pictures: Pictures,  # [N, H, W, 3] in [0, 1]
    reference: Pictures,  # [N, H, W, 3] in [0, 1]
    opaque: npt.NDArray[np.bool_],  # [N, H, W], False where open water was removed
) -> float:
    gain = channel_gain(pictures, reference, opaque)
    matched = np.clip(pictures * gain, 0.0, 1.0)
    views = zip(matched, reference, opaque, strict=True)
    return float(np.mean([psnr(ours, true, shown) for ours, true, shown in views if shown.any()]))


def _held_out(dive: Path) -> list[int]:
    """Recording indices of the held-out frames that have a restored picture."""
    if not held_out_indices(dive, "real"):
        raise InputError(
            f"{dive} holds no held-out frames to compare; give a dive folder that was mapped with "
            "hold_out_every above 0 and more frames than that"
        )
    indices = held_out_indices(dive, "restored")
    if not indices:
        raise InputError(
            f"{dive} holds no restored pictures, because its map has no water to remove; map it "
            "with mapping.medium.enabled"
        )
    return indices


def _load_stored(
    dive: Path, indices: list[int], kind: Kind
) -> tuple[Pictures, npt.NDArray[np.bool_]]:
    """The pictures, and where they show something [N, H, W]."""
    pictures, shown = zip(*(read_picture(dive, index, kind) for index in indices), strict=True)
    return _in_unit(list(pictures)), np.stack(shown)


def _in_unit(
    pictures: list[npt.NDArray[Any]],  # [H, W, 3] each, 8 bit
) -> Pictures:
    return np.stack(pictures).astype(np.float32) / np.float32(255.0)


def clean_pictures(dive: Path, clean: Path, crop: str | None, indices: list[int]) -> Pictures:
    """The frames of ``clean``, cropped, resized and undistorted as the dive's were.

    Raises:
        InputError: a frame is missing or cannot be read.
        ConfigError: the crop does not fit the pictures.
    """
    read = Dive(dive)
    source = read.config.source.model_copy(update={"crop": crop, "mask": None})
    if (clean / SYNTHETIC_MARK).is_file():
        clean = clean / SYNTHETIC_CLEAN
    prepare = Preparation(source, read.calibration)
    found = {frame.index: prepare(frame).image for frame in _frames(clean, indices)}
    missing = [index for index in indices if index not in found]
    if missing:
        raise InputError(
            f"{clean} has no readable frame {missing[0]}, which the dive holds out; give the "
            "recording of the same frames"
        )
    return _in_unit([found[index] for index in indices])


def _frames(clean: Path, indices: list[int]) -> Iterator[Frame]:
    """The wanted frames, decoding as few others as the recording's order allows."""
    first = indices[0]
    every = math.gcd(*(index - first for index in indices)) or 1
    recording = open_recording(clean)
    try:
        for frame in recording.frames(every, first, indices[-1] + 1):
            if isinstance(frame, Frame) and frame.index in indices:
                yield frame
    finally:
        recording.close()


# --------------------------------------------------------------------------------------------------
# The methods by the keys of ``contract.NAMES``.

METHODS: dict[str, Method] = {
    "sea_thru": sea_thru.restore,
    "udcp": udcp.restore,
    "grey_world": contract.restore,
}


# --------------------------------------------------------------------------------------------------
# The map's ranges of a dive's held-out views.


def held_out_ranges(dive: Path, indices: Sequence[int], size: tuple[int, int]) -> Ranges | None:
    """[N, H, W] in the dive's unit, 0 where the map is not solid; None if any is missing or
    damaged.

    ``size`` is the height and width of the held-out pictures.
    """
    found = []
    for index in indices:
        try:
            z = read_range(dive, index)
        except InputError:
            return None
        if z is None or z.shape != size:
            return None
        found.append(z)
    return np.stack(found)
