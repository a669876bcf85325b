"""What a recorder burns into its pictures: a running clock, a crosshair, a panel of readings."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic.config import Display

Picture = npt.NDArray[np.uint8]

WHITE = np.array([255, 255, 255], np.float32)
LASER = np.array([60, 255, 90], np.float32)
"""Green, 532 nm."""
START_S = 10 * 3600 + 41 * 60 + 27
"""Time of day of the first picture."""
CHARACTER_WIDTHS = 0.0016
"""Scale of the font over the picture's width: about 40 characters in a line."""
CROSS_WIDTHS = 0.05
"""Length of an arm of the crosshair."""
PANEL = (0.62, 0.03, 0.98, 0.21)
"""Left, top, right, bottom over the picture's sides."""
PANEL_OPACITY, LOGO_OPACITY = 0.55, 0.4
"""Of the panel's dark ground, and of the logo's white."""
LASERS = ((0.42, 0.55), (0.58, 0.55))
"""Over the picture's sides: two parallel lasers."""
LASER_WIDTHS = 0.004
"""Sigma of a dot."""


def burn_in(
    picture: Picture,  # [H, W, 3], changed in place
    display: Display,
    t_s: float,
) -> None:
    """Draw the display at time ``t_s`` of the dive."""
    seconds = START_S + int(t_s)
    clock = f"2026-05-14 {seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"
    if display == "panel":
        _panel(picture, clock, t_s)
        return
    _text(picture, clock, 0.02, 0.07)
    _text(picture, f"REC {int(t_s):05d}  CAM 1", 0.02, 0.97)
    if display == "clock_and_crosshair":
        height, width = picture.shape[:2]
        arm, x, y = round(CROSS_WIDTHS * width), width // 2, height // 2
        for end in ((x - arm, y), (x + arm, y), (x, y - arm), (x, y + arm)):
            cv2.line(picture, (x, y), end, (255, 255, 255), 1)


def _panel(
    picture: Picture,  # [H, W, 3], changed in place
    clock: str,
    t_s: float,
) -> None:
    """Clock, heading and depth on a semi-transparent ground, a logo, and two laser dots."""
    height, width = picture.shape[:2]
    left, top, right, bottom = (
        round(share * side) for share, side in zip(PANEL, (width, height) * 2, strict=True)
    )
    ground = np.zeros((height, width), np.float32)
    ground[top:bottom, left:right] = PANEL_OPACITY
    _blend(picture, ground, np.zeros(3, np.float32))
    _text(picture, clock[11:], PANEL[0] + 0.02, PANEL[1] + 0.07)
    heading, depth = (137 + 6 * int(t_s)) % 360, 2.1 + 0.3 * np.sin(0.2 * t_s)
    _text(picture, f"HDG {heading:03d} D {depth:.1f}", PANEL[0] + 0.02, PANEL[1] + 0.15)
    logo = np.zeros((height, width), np.float32)
    middle, radius = (round(0.08 * width), round(0.88 * height)), round(0.05 * width)
    cv2.circle(logo, middle, radius, LOGO_OPACITY, max(2, radius // 4), cv2.LINE_AA)
    cv2.ellipse(logo, middle, (radius, radius // 3), 35, 0, 360, LOGO_OPACITY, 2, cv2.LINE_AA)
    _blend(picture, logo, WHITE)
    row, column = np.mgrid[:height, :width].astype(np.float32)
    for x, y in LASERS:
        away = np.hypot(column - x * width, row - y * height) / (LASER_WIDTHS * width)
        _blend(picture, np.exp(-0.5 * away**2), LASER)


def _text(
    picture: Picture,  # [H, W, 3], changed in place
    text: str,
    x: float,
    y: float,
) -> None:
    """White with a black rim, legible on any picture; its left foot at shares of the sides."""
    height, width = picture.shape[:2]
    at = (round(x * width), round(y * height))
    drawn = np.zeros((height, width), np.uint8)
    scale, font = CHARACTER_WIDTHS * width, cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(drawn, text, at, font, scale, 255, 1, cv2.LINE_AA)
    # Not a bolder text in black: that may be wider.
    rim = cv2.dilate(drawn, np.ones((3, 3), np.uint8))
    for opacity, colour in ((rim, np.zeros(3, np.float32)), (drawn, WHITE)):
        _blend(picture, opacity.astype(np.float32) / 255.0, colour)


def _blend(
    picture: Picture,  # [H, W, 3], changed in place
    opacity: npt.NDArray[np.float32],  # [H, W]
    colour: npt.NDArray[np.float32],  # [3]
) -> None:
    mixed = picture + opacity[..., None] * (colour - picture)
    picture[:] = np.rint(mixed).astype(np.uint8)
