"""The methods that are compared: priors, dense, and keypoint networks alone, sparse."""

from __future__ import annotations

from typing import Any, Protocol

from aquaflow.geometry.camera import CameraModel
from aquaflow.lab.prior_bench.pair import FoundMatches, Picture
from aquaflow.prior.contract import Keypoints, Prior
from aquaflow.prior.fields import pixel_grid
from aquaflow.prior.hybrid import HybridEncoding
from aquaflow.prior.keypoint_networks.keypoint_prior import KeypointEncoding
from aquaflow.prior.keypoint_networks.network import KeypointNetwork, Size, warm_up


class Method(Protocol):
    """What is done once for a picture, and what for a pair."""

    name: str

    def describe(
        self,
        picture: Picture,  # [H, W, 3] RGB
        camera: CameraModel,
    ) -> Any:
        """What :meth:`match` needs of a picture."""
        ...

    def match(self, a: Any, b: Any) -> FoundMatches:
        """Nothing about the motion is expected."""
        ...


class DenseMethod:
    """A prior's flow: a match for every pixel that survives its own check."""

    def __init__(self, name: str, prior: Prior) -> None:
        self.name, self._prior = name, prior
        prior.warm_up()

    def describe(
        self,
        picture: Picture,  # [H, W, 3] RGB
        camera: CameraModel,
    ) -> Any:
        """The encoding; a network's features, which may wait until they are needed, are in it."""
        encoding = self._prior.encode(picture, camera)
        if isinstance(encoding, (HybridEncoding, KeypointEncoding)):
            _ = encoding.features
        return encoding

    def match(self, a: Any, b: Any) -> FoundMatches:
        """Valid matches, and where texture is."""
        pair = self._prior.decode(a, b)
        valid = pair.valid
        here = pixel_grid(*valid.shape)[valid]
        return FoundMatches(here, pair.matches[valid], a.interesting)


class SparseMethod:
    """A keypoint network's own matches; there is no flow."""

    def __init__(self, name: str, network: KeypointNetwork) -> None:
        self.name, self._network = name, network
        warm_up(network)

    def describe(
        self,
        picture: Picture,  # [H, W, 3] RGB
        camera: CameraModel,
    ) -> tuple[Keypoints, Size]:
        """Keypoints, and the picture's height and width."""
        del camera  # a network's keypoints need none
        return self._network.detect(picture), (picture.shape[0], picture.shape[1])

    def match(self, a: Any, b: Any) -> FoundMatches:
        """Keypoints that show the same thing."""
        (keypoints_a, size_a), (keypoints_b, size_b) = a, b
        in_a, in_b = self._network.match(keypoints_a, keypoints_b, size_a, size_b)
        return FoundMatches(keypoints_a.pixels[in_a], keypoints_b.pixels[in_b])
