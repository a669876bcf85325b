"""The numbered examples run as they stand, on the small dive."""

from __future__ import annotations

import ast
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
MOST_LINES = 65


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """``example(1, ...)`` runs the first example with these arguments; what it printed."""

    def run(number: int, *arguments: object) -> str:
        [file] = EXAMPLES.glob(f"{number}_*.py")
        monkeypatch.setattr(sys, "argv", [str(file), *map(str, arguments)])
        runpy.run_path(str(file), run_name="__main__")
        return capsys.readouterr().out

    return run


def picture(path: Path) -> np.ndarray:
    import cv2

    image = cv2.imread(str(path))
    assert image is not None
    return image


def test_there_are_six_short_examples() -> None:
    files = sorted(EXAMPLES.glob("*.py"))
    assert [file.name[0] for file in files] == list("123456")
    assert max(len(file.read_text().splitlines()) for file in files) < MOST_LINES


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.py")), ids=lambda file: file.name)
def test_an_example_needs_public_names_only(file: Path) -> None:
    modules = [
        alias.name if isinstance(node, ast.Import) else str(node.module)
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    ]
    assert [module for module in modules if module.startswith("aquaflow.")] == []


@pytest.mark.parametrize("number", range(1, 7))
def test_an_example_without_its_arguments_says_what_it_takes(example, number: int) -> None:
    with pytest.raises(SystemExit, match=rf"python examples/{number}_\w+.py [A-Z]"):
        example(number)


@pytest.mark.ci
def test_frames_are_tracked_and_mapped_one_by_one(example, small_recording) -> None:
    said = example(1, small_recording / "images" / "%06d.png")
    assert "frame 0: keyframe" in said
    assert "12 of 12 frames have a pose" in said
    assert "map 0 has" in said


@pytest.mark.ci
def test_a_recording_is_mapped_and_its_result_is_read(example, small_recording, tmp_path) -> None:
    said = example(2, small_recording, tmp_path / "dive")
    assert "of 12 frames have a pose" in said
    assert "Gaussians between" in said


def test_a_map_is_drawn_from_a_new_view_with_and_without_water(
    example, small_dive, tmp_path
) -> None:
    assert "covered by the map" in example(3, small_dive, tmp_path / "view.png")
    both = picture(tmp_path / "view.png")
    assert both.shape[1] == 2 * both.shape[0] * 160 // 120
    left, right = np.hsplit(both.astype(float), 2)
    assert np.abs(left - right).mean() > 1.0


def test_a_trajectory_is_plotted_with_its_errors(
    example, small_dive, small_recording, tmp_path
) -> None:
    said = example(4, small_dive, small_recording / "poses.tum", tmp_path / "plot.png")
    error_m = float(said.split("trajectory error: ")[1].split()[0])
    assert 0.0 < error_m < 0.05
    assert picture(tmp_path / "plot.png").size


def test_the_water_is_removed_from_a_picture(example, small_dive, small_recording, tmp_path):
    assert "attenuation" in example(5, small_dive, tmp_path / "clean.png")
    seen, restored = np.hsplit(picture(tmp_path / "clean.png").astype(float), 2)
    clean = picture(small_recording / "clean" / "000008.png").astype(float)
    assert np.abs(restored - clean).mean() < 0.7 * np.abs(seen - clean).mean()


def test_a_recording_of_a_format_of_ones_own_is_mapped(example, small_recording, tmp_path) -> None:
    files = sorted((small_recording / "images").glob("*.png"))[:10]
    images = np.stack([picture(file)[..., ::-1] for file in files])
    np.savez(tmp_path / "own.npz", images=images, t_s=np.arange(len(images)) / 10.0)
    assert "10 frames have a pose" in example(6, tmp_path / "own.npz", tmp_path / "dive")
