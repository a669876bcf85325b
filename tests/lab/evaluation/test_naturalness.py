"""Colours of what is nearest: kept, turned, lost; on small dives written here."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.lab.evaluation.naturalness import evaluate_naturalness

NEAR = (slice(0, 10), slice(0, 10))
"""The nearest tenth of the pixels, which alone are compared."""
TEAL = (60, 130, 120)


def write_view(
    dive: Path,
    index: int,
    real: tuple[int, int, int],
    restored: tuple[int, ...],
    z: np.ndarray | None = None,  # [20, 50]
) -> None:
    """A view whose nearest pixels are of these colours, and the rest of others."""
    folder = dive / "heldout"
    folder.mkdir(parents=True, exist_ok=True)
    for kind, colour in (("real", real), ("restored", restored)):
        picture = np.full((20, 50, len(colour)), 255, np.uint8)
        picture[NEAR] = colour
        bgr = cv2.COLOR_RGB2BGR if len(colour) == 3 else cv2.COLOR_RGBA2BGRA
        cv2.imwrite(str(folder / f"{index:06d}_{kind}.png"), cv2.cvtColor(picture, bgr))
    if z is None:
        z = np.full((20, 50), 3.0, np.float32)
        z[NEAR] = 1.0
    np.savez_compressed(folder / f"{index:06d}_range.npz", z=z)


def lab(colour: tuple[int, ...]) -> np.ndarray:
    unit = np.array([[colour]], np.float32) / 255.0
    return cv2.cvtColor(unit, cv2.COLOR_RGB2LAB)[0, 0]


def test_colours_that_are_kept_are_natural(tmp_path: Path) -> None:
    write_view(tmp_path, 8, TEAL, TEAL)
    found = evaluate_naturalness(tmp_path)
    assert found is not None
    assert found.to_json() == {
        "views": 1,
        "hue_views": 1,
        "hue_shift_deg": pytest.approx(0.0, abs=1e-6),
        "largest_hue_shift_deg": pytest.approx(0.0, abs=1e-6),
        "chroma_difference": pytest.approx(0.0, abs=1e-6),
        "lightness_ratio": pytest.approx(1.0),
    }


def test_the_hue_shift_is_the_angle_between_the_mean_colours(tmp_path: Path) -> None:
    rust = (140, 80, 50)
    write_view(tmp_path, 8, TEAL, rust)
    write_view(tmp_path, 16, TEAL, TEAL)
    found = evaluate_naturalness(tmp_path)
    assert found is not None
    a, b = lab(TEAL), lab(rust)
    cosine = a[1:] @ b[1:] / np.linalg.norm(a[1:]) / np.linalg.norm(b[1:])
    shift = np.degrees(np.arccos(cosine))
    assert shift > 90.0
    assert found.largest_hue_shift_deg == pytest.approx(shift, abs=0.01)
    assert found.hue_shift_deg == pytest.approx(shift / 2.0, abs=0.01)
    more = (np.linalg.norm(b[1:]) - np.linalg.norm(a[1:])) / 2.0
    assert found.chroma_difference == pytest.approx(more, abs=0.01)
    assert found.lightness_ratio == pytest.approx((1.0 + b[0] / a[0]) / 2.0, abs=1e-3)


def test_a_grey_view_has_no_hue_but_its_cast_is_a_chroma_difference(tmp_path: Path) -> None:
    write_view(tmp_path, 8, (120, 120, 120), (150, 110, 100))
    found = evaluate_naturalness(tmp_path)
    assert found is not None
    assert (found.views, found.hue_views) == (1, 0)
    assert found.hue_shift_deg is None
    assert found.largest_hue_shift_deg is None
    assert found.chroma_difference > 15.0


def test_removed_open_water_and_what_has_no_range_are_left_out(tmp_path: Path) -> None:
    write_view(tmp_path, 8, TEAL, (0, 0, 0, 0))
    found = evaluate_naturalness(tmp_path)  # the nearest that is left is white in both
    assert found is not None
    assert found.hue_views == 0
    assert found.lightness_ratio == pytest.approx(1.0)
    write_view(tmp_path, 8, TEAL, TEAL, np.zeros((20, 50), np.float32))
    assert evaluate_naturalness(tmp_path) is None


def test_only_what_was_restored_from_the_camera_is_compared(tmp_path: Path) -> None:
    write_view(tmp_path, 8, TEAL, (0, 0, 0))
    path, near = tmp_path / "heldout" / "000008_confidence.png", np.zeros((20, 50), np.uint8)
    assert cv2.imwrite(str(path), near)
    assert evaluate_naturalness(tmp_path) is None
    near[:, -5:] = 200
    assert cv2.imwrite(str(path), near)
    found = evaluate_naturalness(tmp_path)  # far away, and white in both
    assert found is not None
    assert found.lightness_ratio == pytest.approx(1.0)
    path.write_bytes(b"no picture")
    with pytest.raises(InputError, match="confidence"):
        evaluate_naturalness(tmp_path)


def test_a_dive_without_restored_views_or_ranges_has_no_naturalness(tmp_path: Path) -> None:
    assert evaluate_naturalness(tmp_path) is None
    write_view(tmp_path, 8, TEAL, TEAL)
    (tmp_path / "heldout" / "000008_range.npz").unlink()
    assert evaluate_naturalness(tmp_path) is None


@pytest.mark.parametrize("name", ["000008_range.npz", "000008_real.png", "000008_restored.png"])
def test_a_damaged_file_is_named(tmp_path: Path, name: str) -> None:
    write_view(tmp_path, 8, TEAL, TEAL)
    (tmp_path / "heldout" / name).write_bytes(b"PK\x03\x04 no such thing")
    with pytest.raises(InputError, match=name):
        evaluate_naturalness(tmp_path)


def test_pictures_and_ranges_of_different_sizes_are_refused(tmp_path: Path) -> None:
    write_view(tmp_path, 8, TEAL, TEAL, np.ones((10, 25), np.float32))
    with pytest.raises(InputError, match=r"frame 8 .* differ in size"):
        evaluate_naturalness(tmp_path)
