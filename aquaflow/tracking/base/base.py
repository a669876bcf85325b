"""An earlier dive as another one sees it: keyframes without pictures, read and never changed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.keyframes.place import KeyframePlace, KeypointDepths
from aquaflow.telemetry.world_frame import WorldFrame


@dataclass(frozen=True)
class Base:
    """The places of an earlier dive, and where they are."""

    folder: Path
    prior: str
    """That described its keypoints; empty where that is not known."""
    places: Sequence[KeyframePlace]
    keypoints: Callable[[int], KeypointDepths]
    """Of a keyframe, by its number; raises InputError where they cannot be read."""
    frames: Mapping[int, WorldFrame]
    """By sub-map: where it lies in n, as the dive's files have it."""

    @property
    def name(self) -> str:
        """Of its folder."""
        return self.folder.resolve().name

    def frame(self, sub_map: int) -> WorldFrame:
        """Of a sub-map; the unknown one where there is none."""
        return self.frames.get(sub_map, WorldFrame.unknown())

    def refuse_other_prior(self, prior: str) -> None:
        """Check that its keypoints can be compared with those of ``prior``.

        Raises:
            InputError: another prior has described them.
        """
        if self.prior and self.prior != prior:
            raise InputError(
                f"the places of {self.folder} were described by the {self.prior} prior, this dive "
                f"has {prior}; map it with the same prior"
            )
