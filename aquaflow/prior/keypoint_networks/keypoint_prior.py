"""A keypoint network as a prior: flow starts at its matches, as it does at SIFT's homography."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.pixels import at_pixels
from aquaflow.prior import flow as dense
from aquaflow.prior.candidates import from_homography, from_prediction
from aquaflow.prior.contract import Encoding, Float, Keypoints, Mask
from aquaflow.prior.flow_pair import FlowEncoding, FlowPair
from aquaflow.prior.flow_prior import FlowPrior
from aquaflow.prior.keypoint_networks.network import KeypointNetwork, Picture, Size, warm_up
from aquaflow.prior.keypoint_networks.start import flow_from_matches

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
