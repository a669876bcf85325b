"""The camera of a dive without calibration, as its own pictures show it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from aquaflow.base.errors import ConfigError
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.optics import LENS_PRIOR_SIGMA
from aquaflow.geometry.rectification import Rectifier
from aquaflow.keyframes import Keyframe
from aquaflow.tracking.calibration_check import most_turning, view_of
from aquaflow.tracking.lens_views import MOST_VIEWS
from aquaflow.tracking.self_calibration import FoundLens, found_lens

log = logging.getLogger(__name__)

UNKNOWN_PERCENT = round(100.0 * float(LENS_PRIOR_SIGMA[0]))
"""Standard deviation of a guessed focal length."""


@dataclass(frozen=True)
class FoundCamera:
    """A calibration with the uncertainty that the dive leaves of it."""

    camera: CameraModel
    """For pictures of the mapped width, distortion and all."""
    lens: FoundLens
    used: bool
    """True if the dive was mapped with it; False if it is known only at the end."""

    def to_json(self) -> dict[str, Any]:
        """For metrics.json; px of the mapped width."""
        focal, sigma = self.camera.fx, self.lens.sigma
        return {
            "verdict": "found" if self.lens.known else "cannot be told",
            "used": self.used,
            "focal_px": round(focal, 2),
            "focal_sigma_px": round(focal * float(sigma[0]), 2),
            "focal_widths": round(focal / self.camera.width, 4),
            "k1": round(float(self.lens.lens[1]), 4),
            "k1_sigma": round(float(sigma[1]), 4),
            "noise_px": round(self.lens.noise * focal, 3),
            "keyframes": self.lens.views,
            "matches": self.lens.matches,
        }

    @property
    def suggested(self) -> bool:
        """True if it is good enough for the next dive, and this one did without it."""
        return self.lens.known and not self.used

    @property
    def words(self) -> str:
        """Values, standard deviations, and what they are from."""
        focal, sigma = self.camera.fx, self.lens.sigma
        return (
            f"{focal:.0f} ± {focal * sigma[0]:.0f} px ({100.0 * sigma[0]:.1f} %), radial "
            f"distortion {self.lens.lens[1]:.3f} ± {sigma[1]:.3f}, from {self.lens.views} keyframes"
        )


def in_words(found: FoundCamera | None, tracked: CameraModel, file: str) -> str:
    """A sentence on a dive without calibration, mapped with ``tracked``; ``file`` holds what was
    found too late to be used."""
    guessed = found.camera if found is not None and found.used else tracked
    unknown = f"{guessed.fx:.0f} px is a guess, good to {UNKNOWN_PERCENT} %"
    if found is None:
        return (
            f"no calibration was used, and too few pictures show the lens: the focal length of "
            f"{unknown}, distortion ignored"
        )
    if not found.lens.known:
        return (
            "no calibration was used, and the camera's motion does not determine its focal "
            f"length: {unknown}; turn the camera while filming, or calibrate it in water"
        )
    if found.used:
        return f"no calibration was used: focal length found to be {found.words}"
    return (
        f"no calibration was used: the dive was mapped with a focal length of {tracked.fx:.0f} "
        f"px and no distortion; at its end the focal length was found to be {found.words}; give "
        f"{file} to the next dive as calibration"
    )


def from_keyframes(keyframes: Sequence[Keyframe]) -> FoundCamera | None:
    """The camera that the keyframes of a finished dive show.

    Raises:
        InputError: a keyframe cannot be read back.
    """
    chosen = most_turning([each for each in keyframes if each.T_wc.is_finite()], MOST_VIEWS)
    views = [view_of(keyframe) for keyframe in chosen]
    lens = found_lens(views)
    if lens is None:
        return None
    camera = usable(lens.camera(views[0].camera))
    return None if camera is None else FoundCamera(camera, lens, used=False)


def usable(camera: CameraModel) -> CameraModel | None:
    """None for a distortion that folds the picture over itself."""
    try:
        Rectifier(camera, camera.width)
    except ConfigError:
        log.warning("the lens that was found cannot be: %s", camera)
        return None
    return camera
