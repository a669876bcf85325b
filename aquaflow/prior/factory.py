"""Which prior tracks: the one that the config asks for, or the safety net, never unannounced."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from aquaflow.base.worker import core_count
from aquaflow.config.tracking import PriorConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.prior.contract import Encoding, Float, Mask, PairGeometry, Prior
from aquaflow.prior.folder import CARD
from aquaflow.prior.runtime import RuntimeSettings

if TYPE_CHECKING:
    from aquaflow.prior.keypoint_networks.keypoint_prior import KeypointNetwork

NetworkKind = Literal["xfeat", "aliked"]
"""Networks of others, by their kind of prior."""

log = logging.getLogger(__name__)

SHIPPED = Path(__file__).parent / "weights" / "compact"
"""The compact prior's export, which is part of the package."""


def make_prior(config: PriorConfig) -> Prior:
    """The prior of ``config``; classical, with a warning, where the compact one cannot be had.

    Raises:
        InputError: the asked-for folder is no prior, or a file in it was changed.
        AquaFlowError: the processor asked for, or a keypoint network's package, is not there.
    """
    prior = _choose(config)
    return prior if config.confidence else UnweightedPrior(prior)


def _choose(config: PriorConfig) -> Prior:
    if config.kind == "classical":
        return ClassicalPrior()
    if config.kind in ("xfeat", "aliked"):
        from aquaflow.prior.keypoint_networks.keypoint_prior import KeypointPrior

        network = keypoint_network(config.kind, config.device)
        return KeypointPrior(network, config.learned_matches)
    folder = config.folder or SHIPPED
    missing = _missing(folder) if config.kind == "compact" else None
    if missing is not None:
        log.warning("tracking with the classical prior: %s", missing)
        return ClassicalPrior()
    from aquaflow.prior.describers import describer_in
    from aquaflow.prior.hybrid import HybridPrior

    settings = RuntimeSettings(
        config.device, config.precision, min(config.threads, core_count()), config.engine_cache
    )
    describer = describer_in(folder, settings)
    own_matches = config.matches == "network"
    if own_matches and describer.describes != "pixels":
        log.warning("matches are flow's: %s gives no descriptors of all pixels", describer.name)
    return HybridPrior(describer, config.learned_matches, own_matches)


def keypoint_network(kind: NetworkKind, device: str) -> KeypointNetwork:
    """A network of others; their packages are imported here and nowhere else.

    Raises:
        AquaFlowError: a package or the device is not there.
    """
    if kind == "xfeat":
        from aquaflow.prior.keypoint_networks.aliked import XFeat

        return XFeat(device)
    from aquaflow.prior.keypoint_networks.aliked import AlikedLightGlue

    return AlikedLightGlue(device)


def _missing(folder: Path) -> str | None:
    """What the compact prior lacks here, with its remedy."""
    if find_spec("onnxruntime") is None:
        return "onnxruntime is not installed; pip install 'aquaflow[prior]' for the learned one"
    if not (folder / CARD).is_file():
        return (
            f"there are no weights in {folder}; train them with `aquaflow lab prior train compact`"
        )
    return None


# --------------------------------------------------------------------------------------------------
# A prior without its confidence, to find out what C is worth (`aquaflow lab ablate`).


class UnweightedPair:
    """A pair all of whose valid matches count the same."""

    def __init__(self, pair: PairGeometry) -> None:
        self._pair = pair

    def __getattr__(self, name: str) -> Any:
        return getattr(self._pair, name)

    @cached_property
    def C(self) -> Float:
        return self._pair.valid.astype(np.float32)


class UnweightedPrior:
    """Another prior whose matches all count the same."""

    def __init__(self, prior: Prior) -> None:
        self._prior = prior
        self.name, self.ranged, self.metric = prior.name, prior.ranged, prior.metric
        self.matching, self.unit_sigma = prior.matching, prior.unit_sigma

    def encode(
        self,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
        camera: CameraModel,
        mask: Mask | None = None,  # [H, W] True where the scene is seen
    ) -> Encoding:
        """The other prior's."""
        return self._prior.encode(image, camera, mask)

    def decode(
        self,
        a: Encoding,
        b: Encoding,
        predicted: Float | None = None,  # [H, W, 2] px, expected matches of a in b
        alone: bool = False,
    ) -> PairGeometry:
        """The other prior's, with C 1 where a match is valid."""
        pair: Any = UnweightedPair(self._prior.decode(a, b, predicted, alone))
        found: PairGeometry = pair
        return found

    def pack(self, encoding: Encoding) -> dict[str, npt.NDArray[Any]]:
        """The other prior's."""
        return self._prior.pack(encoding)

    def unpack(
        self,
        arrays: Mapping[str, npt.NDArray[Any]],  # as from pack
        camera: CameraModel,
    ) -> Encoding:
        """The other prior's."""
        return self._prior.unpack(arrays, camera)

    def warm_up(self) -> None:
        """The other prior's."""
        self._prior.warm_up()
