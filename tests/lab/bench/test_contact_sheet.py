"""The contact sheet: which pictures stand where, and what is refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from aquaflow.base.storage.atomic import write_yaml
from aquaflow.config import Config
from aquaflow.lab.bench.contact_sheet import GAP_PX, LINE_PX, TILE_PX, main

RED, GREEN, BLUE, GREY = (200, 0, 0), (0, 200, 0), (0, 0, 200), (128, 128, 128)
MIDDLE = 16
HEIGHT_PX = round(TILE_PX * 48 / 64)
"""Of a tile: the pictures here are 64 x 48."""


def save(path: Path, colour: tuple[int, ...], width: int = 64) -> None:
    picture = np.full((48, width, len(colour)), colour, np.uint8)
    to_bgr = cv2.COLOR_RGB2BGR if len(colour) == 3 else cv2.COLOR_RGBA2BGRA
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), cv2.cvtColor(picture, to_bgr))


def write_dive(folder: Path, restored: tuple[int, ...] | None) -> Path:
    """A dive whose middle held-out view alone is red and ``restored``; the others are black."""
    for index in (8, MIDDLE, 24):
        save(folder / "heldout" / f"{index:06d}_real.png", RED if index == MIDDLE else (0, 0, 0))
        if restored is not None:
            path = folder / "heldout" / f"{index:06d}_restored.png"
            save(path, restored if index == MIDDLE else (0, 0, 0))
    write_yaml(folder / "config.yaml", Config.model_validate({}).model_dump(mode="json"))
    return folder


def write_clean(folder: Path) -> Path:
    """A recording without water, blue at the middle held-out view."""
    for index in range(26):
        save(folder / f"{index:06d}.png", BLUE if index == MIDDLE else (0, 0, 0))
    return folder


def colours(sheet: Path, rows: int) -> list[list[tuple[int, ...]]]:
    """The colour in the middle of each tile."""
    picture: npt.NDArray[np.uint8] = np.asarray(Image.open(sheet).convert("RGB"))
    assert picture.shape[1] == 3 * TILE_PX + 4 * GAP_PX
    tops = [LINE_PX + LINE_PX + row * (HEIGHT_PX + LINE_PX) for row in range(rows)]
    lefts = [GAP_PX + i * (TILE_PX + GAP_PX) for i in range(3)]
    return [
        [tuple(picture[top + HEIGHT_PX // 2, left + TILE_PX // 2].tolist()) for left in lefts]
        for top in tops
    ]


def test_each_dive_is_a_row_of_camera_restored_and_truth(tmp_path: Path) -> None:
    first, second = write_dive(tmp_path / "a", GREEN), write_dive(tmp_path / "b", None)
    sheet = tmp_path / "sheet.png"
    main([str(sheet), f"{first}={write_clean(tmp_path / 'clean')}", str(second)])
    assert colours(sheet, 2) == [[RED, GREEN, BLUE], [RED, GREY, GREY]]


def test_transparent_open_water_is_grey(tmp_path: Path) -> None:
    dive = write_dive(tmp_path / "a", (0, 0, 0, 0))
    main([str(tmp_path / "sheet.png"), str(dive)])
    assert colours(tmp_path / "sheet.png", 1) == [[RED, GREY, GREY]]


def test_of_a_side_by_side_recording_the_right_half_is_the_truth(tmp_path: Path) -> None:
    clean = write_clean(tmp_path / "side_by_side")
    for path in clean.iterdir():
        picture = cv2.imread(str(path))
        cv2.imwrite(str(path), np.hstack([np.zeros_like(picture), picture]))
    main([str(tmp_path / "sheet.png"), f"{write_dive(tmp_path / 'a', GREEN)}={clean}"])
    assert colours(tmp_path / "sheet.png", 1) == [[RED, GREEN, BLUE]]


def test_a_jpeg_is_a_jpeg(tmp_path: Path) -> None:
    main([str(tmp_path / "sheet.jpg"), str(write_dive(tmp_path / "a", GREEN))])
    assert (tmp_path / "sheet.jpg").read_bytes().startswith(b"\xff\xd8")


@pytest.mark.parametrize(
    ("out", "dive", "said"),
    [
        ("sheet.gif", "a", "must end in one of .jpg"),
        ("sheet.png", "none", "holds no held-out views"),
        ("none/sheet.png", "a", "cannot write"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_sentence(
    tmp_path: Path, out: str, dive: str, said: str
) -> None:
    write_dive(tmp_path / "a", GREEN)
    with pytest.raises(SystemExit, match=said):
        main([str(tmp_path / out), str(tmp_path / dive)])
    assert not (tmp_path / out).exists()


def test_a_sheet_too_large_for_a_page_is_not_written(tmp_path: Path) -> None:
    dive = write_dive(tmp_path / "a", GREEN)
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    cv2.imwrite(str(dive / "heldout" / f"{MIDDLE:06d}_real.png"), noise)
    with pytest.raises(SystemExit, match=r"more than 1; give fewer dives"):
        main([str(tmp_path / "sheet.png"), *[str(dive)] * 12])
    assert not (tmp_path / "sheet.png").exists()
