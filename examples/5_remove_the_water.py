"""Remove the water from a picture with the medium that a dive found.

python examples/5_remove_the_water.py DIVE PICTURE.png

`aquaflow export DIVE --format restored` does this for every frame, and also takes care of the
camera's shading, its exposure, and sunlight that moves.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

import aquaflow

LEAST_LIGHT = 0.05  # transmission below which noise is all that is left of the scene


def main(dive_folder: str, picture: str) -> None:
    """Restore the first held-out frame of the dive."""
    dive = aquaflow.read_dive(dive_folder)
    if dive.medium is None:
        print(f"{dive_folder} models no water: there is nothing to remove")
        return
    # A held-out frame: the camera's picture, and the range that the map has at each pixel.
    file = sorted(Path(dive_folder, "heldout").glob("*_real.png"))[0]
    seen = cv2.imread(str(file)).astype(np.float32)[..., ::-1] / 255.0
    with np.load(str(file).replace("_real.png", "_range.npz")) as arrays:
        z = arrays["z"]  # [H, W] in the unit of the medium, 0 where the map is not solid

    # I = J exp(-beta_a z) + B(z), solved for J
    transmission, backscatter = dive.medium.transmission(z), dive.medium.backscatter(z)
    clean = (seen - backscatter) / np.maximum(transmission, LEAST_LIGHT)
    known = (z > 0.0)[..., None] & (transmission > LEAST_LIGHT)
    restored = np.where(known, clean, seen).clip(0.0, 1.0)
    share = (backscatter / np.maximum(seen, 1e-3))[z > 0.0].mean(axis=0)
    print(f"attenuation, red green blue: {np.round(dive.medium.beta_a, 3)} per {dive.unit}")
    print(f"backscatter is {share.clip(0.0, 1.0).round(2)} of what the camera saw")
    both = np.hstack([seen, restored])
    cv2.imwrite(picture, (255.0 * both[..., ::-1]).round().astype(np.uint8))


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
