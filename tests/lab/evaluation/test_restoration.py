"""Restored views against pictures without water, on small dives written here."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import write_yaml
from aquaflow.config import Config, parse_config
from aquaflow.lab.evaluation.restoration import evaluate_restoration
from aquaflow.lab.evaluation.summary import in_words
from aquaflow.lab.evaluation.water_peers.contract import NAMES

WIDTH, HEIGHT = 96, 72
INDICES = (8, 16)
COUNT = 18
RANGE = np.broadcast_to(np.linspace(2.0, 0.5, HEIGHT, dtype=np.float32)[:, None], (HEIGHT, WIDTH))

Picture = npt.NDArray[np.uint8]


def scene(index: int) -> Picture:
    """What the camera would see without water; another picture for every index."""
    noise = np.random.default_rng(index).uniform(40, 200, (9, 12, 3)).astype(np.float32)
    return cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC).astype(np.uint8)


def in_water(picture: Picture) -> Picture:
    """Dimmed by channel, and veiled."""
    return (picture * np.array([0.3, 0.6, 0.7]) + np.array([10.0, 60.0, 70.0])).astype(np.uint8)


def save(path: Path, rgb: Picture) -> None:
    assert cv2.imwrite(str(path), np.ascontiguousarray(rgb[..., ::-1]))


def write_dive(folder: Path, restored_gain: tuple[float, float, float] | None) -> Path:
    (folder / "heldout").mkdir(parents=True)
    write_yaml(folder / "config.yaml", Config.model_validate({}).model_dump(mode="json"))
    for index in INDICES:
        picture = scene(index)
        save(folder / "heldout" / f"{index:06d}_real.png", in_water(picture))
        np.savez(folder / "heldout" / f"{index:06d}_range.npz", z=RANGE)
        if restored_gain is not None:
            restored = (picture * np.array(restored_gain)).astype(np.uint8)
            save(folder / "heldout" / f"{index:06d}_restored.png", restored)
    return folder


def write_clean(folder: Path, side_by_side: bool = False, count: int = COUNT) -> Path:
    folder.mkdir(parents=True)
    for index in range(count):
        picture = scene(index)
        if side_by_side:
            picture = np.concatenate([in_water(picture), picture], axis=1)
        save(folder / f"{index}.png", picture)
    return folder


def test_a_scene_restored_up_to_white_balance_beats_the_raw_pictures(tmp_path: Path) -> None:
    dive = write_dive(tmp_path / "dive", (0.9, 0.5, 0.7))
    result = evaluate_restoration(dive, write_clean(tmp_path / "clean"), None).to_json()
    assert result["frames"] == len(INDICES)
    assert result["psnr_restored"] > 45.0
    assert result["psnr_raw"] < 25.0
    assert result["gain_db"] == pytest.approx(result["psnr_restored"] - result["psnr_raw"])


def test_removed_open_water_is_not_compared(tmp_path: Path) -> None:
    """Neither in the restored pictures, where it is black, nor in the raw ones."""
    dive, clean = write_dive(tmp_path / "dive", (0.8, 0.8, 0.8)), write_clean(tmp_path / "clean")
    for index in INDICES:
        for kind, colour in (("restored", 0), ("real", 255)):
            path = dive / "heldout" / f"{index:06d}_{kind}.png"
            picture = cv2.imread(str(path))
            picture[:40] = colour
            alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
            alpha[:40] = 0
            cv2.imwrite(str(path), np.dstack([picture, alpha]) if kind == "restored" else picture)
    found = evaluate_restoration(dive, clean, None)
    assert found.psnr_restored > 45.0
    assert found.psnr_raw > 12.0


def test_a_view_of_nothing_but_removed_open_water_is_left_out(tmp_path: Path) -> None:
    dive, clean = write_dive(tmp_path / "dive", (0.8, 0.8, 0.8)), write_clean(tmp_path / "clean")
    nothing = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    cv2.imwrite(str(dive / "heldout" / f"{INDICES[0]:06d}_restored.png"), nothing)
    assert evaluate_restoration(dive, clean, None).psnr_restored > 45.0
    cv2.imwrite(str(dive / "heldout" / f"{INDICES[1]:06d}_restored.png"), nothing)
    with pytest.raises(InputError, match="nothing but removed open water"):
        evaluate_restoration(dive, clean, None)


def test_published_methods_restore_the_same_views(tmp_path: Path) -> None:
    dive = write_dive(tmp_path / "dive", (0.9, 0.5, 0.7))
    result = evaluate_restoration(dive, write_clean(tmp_path / "clean"), None).to_json()
    found = [result[f"psnr_{name}"] for name in NAMES]
    assert result["peer_reasons"] == {}
    assert len(set(found) | {result["psnr_raw"]}) == len(NAMES) + 1
    assert all(5.0 < value < result["psnr_restored"] for value in found)


def test_a_method_that_cannot_restore_is_null_with_its_reason(tmp_path: Path) -> None:
    dive = write_dive(tmp_path / "dive", (0.9, 0.5, 0.7))
    (dive / "heldout" / f"{INDICES[0]:06d}_range.npz").unlink()
    result = evaluate_restoration(dive, write_clean(tmp_path / "clean"), None).to_json()
    assert result["psnr_sea_thru"] is None
    assert result["psnr_udcp"] is not None
    assert list(result["peer_reasons"]) == ["sea_thru"]
    [line] = [line for line in in_words({"restoration": result}) if "Sea-thru" in line]
    assert line.endswith(f"- ({result['peer_reasons']['sea_thru']})")


def test_black_pictures_cost_only_the_methods(tmp_path: Path) -> None:
    dive = write_dive(tmp_path / "dive", (0.9, 0.5, 0.7))
    for index in INDICES:
        black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        save(dive / "heldout" / f"{index:06d}_real.png", black)
    result = evaluate_restoration(dive, write_clean(tmp_path / "clean"), None)
    assert result.psnr_restored > 45.0
    assert result.psnr_peers == {}
    assert set(result.peer_reasons) == set(NAMES)


def test_one_gain_serves_all_frames(tmp_path: Path) -> None:
    """A restoration whose brightness flickers is not forgiven."""
    dive = write_dive(tmp_path / "dive", (0.9, 0.9, 0.9))
    path = dive / "heldout" / f"{INDICES[0]:06d}_restored.png"
    save(path, (scene(INDICES[0]) * 0.5).astype(np.uint8))
    assert evaluate_restoration(dive, write_clean(tmp_path / "c"), None).psnr_restored < 25.0


def test_a_half_of_a_side_by_side_recording_is_compared(tmp_path: Path) -> None:
    dive = write_dive(tmp_path / "dive", (0.8, 0.8, 0.8))
    both = write_clean(tmp_path / "both", side_by_side=True)
    right, left = (evaluate_restoration(dive, both, crop) for crop in ("right", "left"))
    assert right.psnr_restored > 45.0
    assert left.psnr_raw > right.psnr_raw


def test_a_synthetic_dive_is_compared_with_its_clean_pictures(tmp_path: Path) -> None:
    dive = write_dive(tmp_path / "dive", (0.8, 0.8, 0.8))
    write_clean(tmp_path / "synthetic" / "clean")
    (tmp_path / "synthetic" / "synth.yaml").touch()
    assert evaluate_restoration(dive, tmp_path / "synthetic", None).psnr_restored > 45.0


def test_the_clean_pictures_are_resized_as_the_dive_was(tmp_path: Path) -> None:
    dive = write_dive(tmp_path / "dive", (0.8, 0.8, 0.8))
    write_yaml(
        dive / "config.yaml",
        parse_config({"source": {"width": WIDTH}}, "test").model_dump(mode="json"),
    )
    large = tmp_path / "large"
    large.mkdir()
    for index in range(COUNT):
        size = (2 * WIDTH, 2 * HEIGHT)
        save(large / f"{index}.png", cv2.resize(scene(index), size, interpolation=cv2.INTER_CUBIC))
    assert evaluate_restoration(dive, large, None).psnr_restored > 40.0


def test_a_dive_without_held_out_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no held-out frames"):
        evaluate_restoration(tmp_path, write_clean(tmp_path / "clean"), None)


def test_a_dive_without_water_is_refused(tmp_path: Path) -> None:
    dive = write_dive(tmp_path / "dive", None)
    with pytest.raises(InputError, match="no water to remove"):
        evaluate_restoration(dive, write_clean(tmp_path / "clean"), None)


def test_pictures_of_another_shape_are_refused(tmp_path: Path) -> None:
    dive = write_dive(tmp_path / "dive", (0.8, 0.8, 0.8))
    both = write_clean(tmp_path / "both", side_by_side=True)
    with pytest.raises(InputError, match=r"192 x 72 .* 96 x 72"):
        evaluate_restoration(dive, both, None)


def test_a_recording_that_is_too_short_is_refused(tmp_path: Path) -> None:
    dive = write_dive(tmp_path / "dive", (0.8, 0.8, 0.8))
    with pytest.raises(InputError, match="no readable frame 16"):
        evaluate_restoration(dive, write_clean(tmp_path / "clean", count=12), None)


def test_a_damaged_picture_of_the_dive_is_named(tmp_path: Path) -> None:
    dive = write_dive(tmp_path / "dive", (0.8, 0.8, 0.8))
    damaged = dive / "heldout" / f"{INDICES[1]:06d}_restored.png"
    damaged.write_bytes(b"no picture")
    with pytest.raises(InputError, match=damaged.name):
        evaluate_restoration(dive, write_clean(tmp_path / "clean"), None)
