"""Render a map from where no camera was: python examples/3_render_a_new_view.py DIVE PICTURE.png

The picture shows the map through the water on the left, and without it on the right.
"""

from __future__ import annotations

import sys

import cv2
import numpy as np

import aquaflow

ASIDE = 0.1  # metres, or map units: a tenth of the median depth that the first keyframe saw


def main(dive: str, picture: str) -> None:
    """Draw the map in ``dive`` from next to its middle view."""
    scene = aquaflow.load_map(dive)
    view = scene.views[len(scene.views) // 2]
    # Camera axes are x right, y down, z forward; T_wc takes them to the world.
    to_the_right = view.T_wc @ aquaflow.Sim3(np.eye(3), np.array([ASIDE, 0.0, 0.0]))
    shown = scene.render(to_the_right, view.camera)
    covered = shown.alpha > 0.5
    depths = np.percentile(shown.range[covered], (5, 50, 95)).round(2)
    print(f"{covered.mean():.0%} of the picture is covered by the map")
    print(f"ranges, 5th, 50th and 95th percentile: {depths} {scene.unit}")
    both = np.hstack([shown.image, shown.clean]).clip(0.0, 1.0)
    cv2.imwrite(picture, (255.0 * both[..., ::-1]).round().astype(np.uint8))


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
