"""Frames without their water, from a dive folder and, if it is given, its recording."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import torch
from typer.testing import CliRunner

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import write_yaml
from aquaflow.cli import app
from aquaflow.config import Config, MappingConfig
from aquaflow.dive.dive import Dive
from aquaflow.dive.map_file import write_map_file
from aquaflow.dive.restored import export_restored
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import to_bytes
from tests.mapping.mapping_scenes import floor, renderer, view_of

Written = tuple[Path, Path, npt.NDArray[np.uint8]]


@pytest.fixture
def dive(tmp_path: Path) -> Written:
    """A dive folder of three frames, its recording, and the first picture without water."""
    mapper = Mapper(MappingConfig(), renderer(), seed=0)
    mapper.scene.gaussians = floor(columns=40, rows=30, scale=0.06)
    murk = (torch.tensor(v) for v in ((0.4, 0.2, 0.15), (0.1, 0.25, 0.3), (0.4, 0.3, 0.2)))
    mapper.medium.set_water(*murk)
    blank = np.zeros((48, 64, 3), np.uint8)
    mapper.views = [view_of(blank, index=index) for index in (0, 2, 4)]
    shown = mapper.show(mapper.views[0])
    recording, folder = tmp_path / "pictures", tmp_path / "dive"
    recording.mkdir()
    folder.mkdir()
    for index in range(5):
        cv2.imwrite(str(recording / f"{index:06d}.png"), to_bytes(shown.image.numpy())[..., ::-1])
    write_map_file(folder / "map.aqf", mapper)
    write_yaml(
        folder / "config.yaml",
        Config.model_validate({"source": {"width": 64}}).model_dump(mode="json"),
    )
    return folder, recording, to_bytes(shown.radiance.clamp(0.0, 1.0).numpy())


def pictures(folder: Path) -> dict[str, npt.NDArray[np.uint8]]:
    return {path.name: cv2.imread(str(path))[..., ::-1] for path in sorted(folder.iterdir())}


@pytest.mark.parametrize("recorded", [False, True])
def test_every_mapped_frame_is_written_as_it_would_look_without_water(
    dive: Written, tmp_path: Path, recorded: bool
) -> None:
    folder, recording, clean = dive
    steps: list[tuple[int, int]] = []
    count = export_restored(
        Dive(folder),
        tmp_path / "out",
        recording if recorded else None,
        lambda *step: steps.append(step),
    )
    found = pictures(tmp_path / "out")
    names = ["000000", "000002", "000004"]
    kinds = (".png", "_confidence.png") if recorded else (".png",)
    assert list(found) == [f"{name}{kind}" for name in names for kind in kinds]
    assert count == 3
    assert steps == [(1, 3), (2, 3), (3, 3)]
    first = found["000000.png"].astype(float)
    gain = np.median(first[first > 50] / clean[first > 50])
    assert np.abs(first / gain - clean).mean() < 3.0


def test_the_confidence_is_grey_and_lies_beside_its_picture(dive: Written, tmp_path: Path) -> None:
    folder, recording, _ = dive
    export_restored(Dive(folder), tmp_path / "out", recording)
    path = tmp_path / "out" / "000002_confidence.png"
    confidence = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert confidence.shape == (48, 64)
    assert confidence.max() == 255


@pytest.mark.parametrize("recorded", [False, True])
def test_open_water_that_is_to_be_removed_is_transparent(
    dive: Written, tmp_path: Path, recorded: bool
) -> None:
    folder, recording, _ = dive
    config = MappingConfig.model_validate({"medium": {"open_water": "removed"}})
    mapper = Mapper(config, renderer(), seed=0)
    mapper.scene.gaussians = floor(columns=10, rows=8, scale=0.06)  # leaves the edges open
    mapper.medium.set_water(*(torch.full((3,), 0.2) for _ in range(3)))
    mapper.views = [view_of(np.zeros((48, 64, 3), np.uint8), index=0)]
    solid = mapper.show(mapper.views[0]).alpha.numpy() > 0.5
    assert 0.1 < solid.mean() < 0.9
    write_map_file(folder / "map.aqf", mapper)
    export_restored(Dive(folder), tmp_path / "out", recording if recorded else None)
    picture = cv2.imread(str(tmp_path / "out" / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (48, 64, 4)
    if recorded:  # the dive's pictures show no open water
        assert (picture[..., 3] == 255).all()
    else:
        np.testing.assert_array_equal(picture[..., 3] == 255, solid)
        assert not picture[~solid].any()


def test_a_recording_without_the_frames_is_refused(dive: Written, tmp_path: Path) -> None:
    folder, recording, _ = dive
    (recording / "000004.png").unlink()
    with pytest.raises(InputError, match="no readable frame 4"):
        export_restored(Dive(folder), tmp_path / "out", recording)


def test_a_recording_of_another_shape_is_refused(dive: Written, tmp_path: Path) -> None:
    folder, recording, _ = dive
    for path in recording.iterdir():
        cv2.imwrite(str(path), np.zeros((64, 64, 3), np.uint8))
    with pytest.raises(InputError, match="64 x 64 once prepared"):
        export_restored(Dive(folder), tmp_path / "out", recording)


def test_a_clear_dive_has_nothing_to_restore(dive: Written, tmp_path: Path) -> None:
    mapper = Mapper(MappingConfig(), renderer(), seed=0)
    mapper.medium.active = False
    write_map_file(dive[0] / "map.aqf", mapper)
    with pytest.raises(InputError, match="no water to remove"):
        export_restored(Dive(dive[0]), tmp_path / "out")


def test_the_command_writes_into_the_dive_and_says_so(dive: Written) -> None:
    asked = ["export", str(dive[0]), "--format", "restored"]
    result = CliRunner().invoke(app, [*asked, "--json"])
    assert result.exit_code == 0, result.output
    said = {"out": str(dive[0] / "restored"), "frames": 3, "geotagged": False}
    assert json.loads(result.output) == said
    assert len(pictures(dive[0] / "restored")) == 3
    assert "3 restored frames" in CliRunner().invoke(app, asked).output
