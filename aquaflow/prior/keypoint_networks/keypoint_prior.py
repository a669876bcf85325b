"""A keypoint network as a prior: flow starts at its matches, as it does at SIFT's homography."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from aquaflow.geometry.camera import CameraModel, at_pixels
from aquaflow.prior import flow as dense
from aquaflow.prior.classical import WARM_UP, FlowPrior
from aquaflow.prior.contract import Encoding, Float, Keypoints, Mask
from aquaflow.prior.flow import pixel_grid, sample
from aquaflow.prior.flow_pair import FlowEncoding, FlowPair, from_homography, from_prediction
from aquaflow.prior.homography import MIN_INLIERS, RANSAC_PX, flow_of_homography

FEATURE_PIXELS, FEATURE_DESCRIPTORS = "feature_pixels", "feature_descriptors"
"""Of a packed encoding; ``pixels`` and ``descriptors`` are SIFT's."""


@dataclass
class KeypointEncoding(FlowEncoding):
    """A picture made ready for flow; the network looks at it when first needed."""

    picture: Picture
    network: KeypointNetwork

    @property
    def size(self) -> Size:
        """Height and width, px."""
        height, width = self.grey.shape
        return height, width

    @cached_property
    def features(self) -> Keypoints:
        """The network's keypoints where the scene is seen."""
        found = self.network.detect(self.picture)
        if self.mask is None:
            return found
        seen = at_pixels(self.mask, found.pixels)
        return Keypoints(found.pixels[seen], found.descriptors[seen])

    def pack(self) -> dict[str, npt.NDArray[Any]]:
        """Its arrays, not copied; keypoints of either kind only if they were computed."""
        arrays = super().pack() | {"picture": self.picture}
        features = vars(self).get("features")
        if features is not None:
            arrays |= {
                FEATURE_PIXELS: features.pixels,
                FEATURE_DESCRIPTORS: features.descriptors,
            }
        return arrays

    def restore(
        self,
        arrays: Mapping[str, npt.NDArray[Any]],  # as from pack
    ) -> None:
        """Take back what was computed when first asked for, and packed."""
        super().restore(arrays)
        if FEATURE_PIXELS in arrays:
            self.features = Keypoints(arrays[FEATURE_PIXELS], arrays[FEATURE_DESCRIPTORS])


class KeypointPrior(FlowPrior):
    """Flow that starts from a keypoint network's matches, behind the prior contract."""

    def __init__(self, network: KeypointNetwork, learned_matches: bool = True) -> None:
        """Without ``learned_matches`` flow starts at SIFT's where a prediction fails."""
        super().__init__()
        self.name, self._learned_matches = network.name, learned_matches
        if learned_matches:
            self.matching = f"flow from {network.name}"
        self._network = network

    def encode(
        self,
        image: Picture,  # [H, W, 3] RGB
        camera: CameraModel,
        mask: Mask | None = None,  # [H, W] True where the scene is seen
    ) -> KeypointEncoding:
        """Grey picture and texture for dense flow, and the picture for the network."""
        grey = dense.normalised_grey(image, mask)
        texture = dense.texture(grey, mask)
        return KeypointEncoding(camera, grey, texture, image, self._network, mask=mask)

    def unpack(
        self,
        arrays: Mapping[str, npt.NDArray[Any]],  # as from pack
        camera: CameraModel,
    ) -> KeypointEncoding:
        """The encoding with all that was computed of it."""
        encoding = KeypointEncoding(
            camera, arrays["grey"], arrays["texture"], arrays["picture"], self._network
        )
        encoding.restore(arrays)
        return encoding

    def decode(
        self,
        a: Encoding,
        b: Encoding,
        predicted: Float | None = None,  # [H, W, 2] px, expected matches of a in b
        alone: bool = False,
    ) -> FlowPair:
        """Flow from the prediction; where it fails, unless it stands ``alone``, from the network's
        matches, then from SIFT's."""
        assert isinstance(a, KeypointEncoding)
        assert isinstance(b, KeypointEncoding)
        return FlowPair(a, b, self._flow(a, b, predicted, alone, self._starts(a, b, predicted)))

    def warm_up(self) -> None:
        """Run the network once: the first picture of a dive then waits for no preparation."""
        warm_up(self._network)

    def _starts(
        self,
        a: KeypointEncoding,
        b: KeypointEncoding,
        predicted: Float | None,  # [H, W, 2] px, expected matches of a in b
    ) -> Iterator[Float | None]:
        yield from from_prediction(predicted)
        if self._learned_matches:
            yield from self._from_network(a, b)
        yield from from_homography(a, b)
        yield None

    def _from_network(self, a: KeypointEncoding, b: KeypointEncoding) -> Iterator[Float]:
        in_a, in_b = self._network.match(a.features, b.features, a.size, b.size)
        flow = flow_from_matches(a.features.pixels[in_a], b.features.pixels[in_b], *a.size)
        if flow is not None:
            yield flow


# --------------------------------------------------------------------------------------------------
# A smooth displacement of the whole picture from single matches, for dense flow to start from.

CELL_PX = 8
"""Of the grid that matches are spread on: dense flow corrects what is finer."""
SMOOTH_CELLS = 1.5
"""Sigma of the spreading, as in prior.coarse."""
MOTION_WEIGHT = 0.02
"""Of the homography, in matches per cell: it decides where there is no match, as in prior.coarse.
"""
NEIGHBOURS = 6
"""Nearest matches that judge one; wrong matches seldom have wrong ones alike next to them."""
AGREEMENT = 0.03
"""Of the picture's width: largest difference from the median of the neighbours' residuals."""


def flow_from_matches(
    pixels_a: Float,  # [M, 2] px
    pixels_b: Float,  # [M, 2] px
    height: int,
    width: int,
) -> Float | None:
    """[height, width, 2] px from a to b: the homography of most matches, and around each match
    what it differs from that; None where too few agree."""
    if len(pixels_a) < MIN_INLIERS:
        return None
    H, inliers = cv2.findHomography(pixels_a, pixels_b, cv2.USAC_MAGSAC, RANSAC_PX)
    if H is None or inliers is None or int(inliers.sum()) < MIN_INLIERS:
        return None
    motion = flow_of_homography(np.asarray(H, np.float64), height, width)
    residuals = pixels_b - pixels_a - sample(motion, pixels_a[None])[0]
    good = _agree_with_neighbours(pixels_a, residuals, AGREEMENT * width)
    return motion + _spread(pixels_a[good], residuals[good], height, width)


def _agree_with_neighbours(
    pixels: Float,  # [M, 2] px
    residuals: Float,  # [M, 2] px
    within: float,
) -> Mask:
    """[M]"""
    _, around = cKDTree(pixels).query(pixels, min(NEIGHBOURS + 1, len(pixels)))
    usual = np.median(residuals[around], axis=1)
    return np.asarray(np.linalg.norm(residuals - usual, axis=1) < within)


def _spread(
    pixels: Float,  # [M, 2] px
    residuals: Float,  # [M, 2] px
    height: int,
    width: int,
) -> Float:
    """[height, width, 2] px, smooth; zero far from every match."""
    rows, columns = -(-height // CELL_PX), -(-width // CELL_PX)
    cells = np.clip((pixels / CELL_PX).astype(int), 0, (columns - 1, rows - 1))
    total = np.zeros((rows, columns), np.float32)
    summed = np.zeros((rows, columns, 2), np.float32)
    np.add.at(total, (cells[:, 1], cells[:, 0]), 1.0)
    np.add.at(summed, (cells[:, 1], cells[:, 0]), residuals)
    total = np.asarray(cv2.GaussianBlur(total, (0, 0), SMOOTH_CELLS))
    summed = np.asarray(cv2.GaussianBlur(summed, (0, 0), SMOOTH_CELLS))
    grid = pixel_grid(height, width) / np.float32(CELL_PX)
    return sample(summed / (total + np.float32(MOTION_WEIGHT))[..., None], grid)


# --------------------------------------------------------------------------------------------------
# What a keypoint network does: find points in one picture, and the same points in another.

Picture = npt.NDArray[np.uint8]
Index = npt.NDArray[np.int64]
Size = tuple[int, int]
"""Height and width, px."""


class KeypointNetwork(Protocol):
    """A detector of keypoints and the matcher that it was trained with."""

    name: str

    def detect(
        self,
        picture: Picture,  # [H, W, 3] RGB
    ) -> Keypoints:
        """The strongest keypoints, in this package's pixels; none where nothing is shown."""
        ...

    def match(self, a: Keypoints, b: Keypoints, size_a: Size, size_b: Size) -> tuple[Index, Index]:
        """Indices [M] into a and into b of keypoints that show the same thing."""
        ...


NO_MATCHES = (np.zeros(0, np.int64), np.zeros(0, np.int64))
"""Of pictures without keypoints."""


def no_keypoints(dimension: int) -> Keypoints:
    """Those of a picture that shows nothing; descriptors have ``dimension`` entries."""
    return Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, dimension), np.float32))


def warm_up(network: KeypointNetwork) -> None:
    """Run all of the network once, on a picture that shows nothing."""
    size = WARM_UP[:2]
    keypoints = network.detect(np.zeros(WARM_UP, np.uint8))
    network.match(keypoints, keypoints, size, size)
