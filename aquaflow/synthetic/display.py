"""What a recorder burns into its pictures: a running clock, a crosshair."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.synthetic.config import Display

__all__ = ["burn_in"]

WHITE, BLACK = (255, 255, 255), (0, 0, 0)
"""A white letter with a black rim is legible on any picture."""
START_S = 10 * 3600 + 41 * 60 + 27
"""Time of day of the first picture."""
CHARACTER_WIDTHS = 0.0016
"""Scale of the font over the picture's width: about 40 characters in a line."""
CROSS_WIDTHS = 0.05
"""Length of an arm of the crosshair."""


def burn_in(
    picture: npt.NDArray[np.uint8],  # [H, W, 3], changed in place
    display: Display,
    t_s: float,
) -> None:
    """Draw the display at time ``t_s`` of the dive."""
    height, width = picture.shape[:2]
    seconds = START_S + int(t_s)
    clock = f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"
    lines = (f"2026-05-14 {clock}", (0.02, 0.07)), (f"REC {int(t_s):05d}  CAM 1", (0.02, 0.97))
    for text, (x, y) in lines:
        at = (round(x * width), round(y * height))
        for colour, thickness in ((BLACK, 3), (WHITE, 1)):
            cv2.putText(
                picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, CHARACTER_WIDTHS * width, colour,
                thickness, cv2.LINE_AA,
            )  # fmt: skip
    if display == "clock_and_crosshair":
        arm, x, y = round(CROSS_WIDTHS * width), width // 2, height // 2
        for end in ((x - arm, y), (x + arm, y), (x, y - arm), (x, y + arm)):
            cv2.line(picture, (x, y), end, WHITE, 1)
