"""Another white balance for a finished dive: by name, or by a pixel that is grey."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import torch
from typer.testing import CliRunner

from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.base.storage.atomic import write_yaml
from aquaflow.cli import app
from aquaflow.config import Config
from aquaflow.dive.dive import Dive
from aquaflow.dive.map_file import summarise_water, write_map_file, write_splats
from aquaflow.dive.placement import placement
from aquaflow.dive.ply import read_ply
from aquaflow.dive.point_cloud import read_splats
from aquaflow.dive.results import medium_json
from aquaflow.dive.trajectory_csv import NAME as TRAJECTORY_CSV
from aquaflow.dive.trajectory_csv import PoseRow, write_trajectory_csv
from aquaflow.dive.white_balance import show_in
from aquaflow.mapping.appearance import shown_tone
from aquaflow.mapping.restoration import restored_gaussians
from aquaflow.render.contract import radiance
from aquaflow.survey.viewer.finished import in_chosen_white
from aquaflow.survey.viewer.seen_water import water_of
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.water.mounting import Lamp
from tests.mapping.grey_floor import CAST, mapped
from tests.water.daylit import daylit_grey

DEPTH_M = 12.0


@pytest.fixture
def dive(tmp_path: Path) -> Path:
    """Three views of a grey floor, to which a camera's white balance gives a cast."""
    folder, mapper = tmp_path / "dive", mapped()
    folder.mkdir()
    write_splats(folder, mapper, summarise_water(mapper), WorldFrame.unknown(), "")
    write_map_file(folder / "map.aqf", mapper)
    write_yaml(folder / "config.yaml", Config().model_dump(mode="json"))
    return folder


def pixel(folder: Path, index: int, x: int, y: int) -> npt.NDArray[np.float64]:
    """[3] RGB of the picture without water, mean of a patch."""
    picture = cv2.imread(str(folder / f"{index:06d}.png"))[..., ::-1]
    return np.asarray(picture[y - 2 : y + 3, x - 2 : x + 3].mean(axis=(0, 1)))


def exported(dive: Path, out: Path, *options: str) -> Path:
    asked = ["export", str(dive), "--format", "restored", "--out", str(out), *options]
    result = CliRunner().invoke(app, asked)
    assert result.exit_code == 0, result.output
    return out


def test_a_pixel_that_is_named_becomes_grey(dive: Path, tmp_path: Path) -> None:
    before = pixel(exported(dive, tmp_path / "a"), 1, 30, 20)
    assert before.max() / before.min() > 2.0
    after = pixel(exported(dive, tmp_path / "b", "--white-balance", "1:30,20"), 1, 30, 20)
    assert after.max() / after.min() < 1.06


def test_an_export_can_be_neutral_and_the_next_is_as_the_dive_was_mapped(
    dive: Path, tmp_path: Path
) -> None:
    before = pixel(exported(dive, tmp_path / "a"), 0, 30, 20)
    neutral = pixel(exported(dive, tmp_path / "b", "--white-balance", "neutral"), 0, 30, 20)
    assert neutral.max() / neutral.min() < 1.15
    again = pixel(exported(dive, tmp_path / "c", "--white-balance", "camera"), 0, 30, 20)
    np.testing.assert_array_equal(again, before)


def test_daylight_that_the_scene_contradicts_is_warned_of(
    dive: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_map_file(dive / "map.aqf", mapped(light=(1.0, 0.9, 0.8)))
    row = PoseRow(0, 0.0, None, 0, 0.0, 0.0, 0.0, "m", depth_m=DEPTH_M)
    write_trajectory_csv(dive / TRAJECTORY_CSV, [row])
    show_in(Dive(dive), "daylight:oceanic_II")
    (said,) = caplog.messages
    assert "sigma from the light that the scene itself shows" in said


def test_daylight_where_lamps_light_the_scene_is_warned_of(
    dive: Path, caplog: pytest.LogCaptureFixture
) -> None:
    mapper = mapped(light=daylit_grey(DEPTH_M))
    mapper.scene.lamp = Lamp(share=0.7, power=2.0, range=1.5)
    write_map_file(dive / "map.aqf", mapper)
    row = PoseRow(0, 0.0, None, 0, 0.0, 0.0, 0.0, "m", depth_m=DEPTH_M)
    write_trajectory_csv(dive / TRAJECTORY_CSV, [row])
    show_in(Dive(dive), "daylight")
    (said,) = caplog.messages
    assert said.startswith("lamps light the scene, and daylight is not their light's colour")


def test_a_scene_by_daylight_of_a_depth_becomes_grey(
    dive: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    mapper = mapped(light=daylit_grey(DEPTH_M))
    write_map_file(dive / "map.aqf", mapper)
    poses = [
        PoseRow(i, 0.1 * i, None, 0, 0.0, 0.0, 0.0, "m", depth_m=DEPTH_M + side)
        for i, side in enumerate((-0.5, 0.5, 0.0))
    ]
    elsewhere = PoseRow(3, 0.3, None, 1, 0.0, 0.0, 0.0, "m", depth_m=90.0)
    unknown = PoseRow(4, 0.4, None, 0, 0.0, 0.0, 0.0, "m")
    write_trajectory_csv(dive / TRAJECTORY_CSV, [*poses, elsewhere, unknown])
    before = pixel(exported(dive, tmp_path / "a"), 0, 30, 20)
    assert before.max() / before.min() > 1.5
    asked = ("--white-balance", "Daylight:OCEANIC_ii")
    after = pixel(exported(dive, tmp_path / "b", *asked), 0, 30, 20)
    assert after.max() / after.min() < 1.1
    chosen = Dive(dive)
    show_in(chosen, "daylight:oceanic_ii")
    assert not caplog.messages
    assert chosen.white_balance == "daylight:oceanic_II"
    balance = chosen.map().scene.balance
    assert balance is not None
    assert balance.chosen.name == "daylight:oceanic_II"
    assert balance.chosen.sigma is not None
    assert all(0.01 < sigma < 0.2 for sigma in balance.chosen.sigma)


def test_gaussians_are_exported_as_the_pictures_are(dive: Path) -> None:
    kept, chosen = Dive(dive), Dive(dive)
    show_in(chosen, "neutral")
    plain, neutral = (
        read_splats(each, placement(each.frame), water=False).rows(slice(None))
        for each in (kept, chosen)
    )
    np.testing.assert_array_equal(plain.means, neutral.means)
    np.testing.assert_allclose(plain.colours, read_ply(dive / "map_clear.ply").colours)
    cast = plain.colours.mean(axis=0)
    assert cast[2] / cast[0] > 2.0
    grey = neutral.colours.mean(axis=0)
    assert grey.max() / grey.min() < 1.1


def test_the_clear_map_is_as_light_as_the_pictures_and_its_radiance_can_be_had_again(
    tmp_path: Path,
) -> None:
    mapper = mapped()
    assert mapper.scene.balance is not None
    dark = tuple(0.3 * gain for gain in CAST)
    mapper.scene.balance = replace(mapper.scene.balance, gain=dark)
    summary, tone = summarise_water(mapper), shown_tone(mapper)
    assert summary is not None
    assert summary.exposure == tone.exposure > 1.3
    write_splats(tmp_path, mapper, summary, WorldFrame.unknown(), "")
    colours = read_ply(tmp_path / "map_clear.ply").colours
    above = np.maximum(colours - 0.8, 0.0)
    bright = np.minimum(colours, 0.8) + above / (1.0 - summary.highlight_compression * above)
    J = radiance(mapper.gaussians.parameters["raw_colours"])
    plain = restored_gaussians(mapper.scene, J, mapper.views).numpy()
    np.testing.assert_allclose(bright / summary.exposure, plain, atol=1e-4)


def test_a_browser_shows_the_white_balance_that_was_chosen_and_knows_that_of_the_file(
    dive: Path,
) -> None:
    mapper, chosen = mapped(), Dive(dive)
    medium = medium_json(summarise_water(mapper), WorldFrame.unknown())
    in_file = water_of(medium)
    assert in_file is not None
    show_in(chosen, "neutral")
    shown = in_chosen_white(chosen, in_file)
    gain = np.multiply(shown.gain, shown.white)
    assert gain.max() / gain.min() < 1.1
    np.testing.assert_allclose(
        shown.gain, np.multiply(CAST, shown_tone(mapper).exposure), rtol=1e-6
    )
    assert shown.compression == in_file.compression
    assert shown.shown_compression == shown_tone(chosen.map()).compression


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("sepia", "'sepia' is no white balance; give camera, neutral, daylight, daylight:T"),
        ("daylight:4D", "'daylight:4D' names no water type .* oceanic_I, .*, coastal_9C"),
        ("daylight", "no depth below the surface.*map it with --telemetry"),
        ("daylight:oceanic_II", "no depth below the surface.*map it with --telemetry"),
        ("1:3", "is no white balance"),
        ("x:3,4", "is no white balance"),
        ("1:nan,4", "is no white balance"),
        ("7:3,4", "frame 7 of .* was not mapped; the nearest mapped one is 2"),
        ("1:64,4", "outside of the mapped picture of 64 x 48 pixels"),
    ],
)
def test_what_is_no_white_balance_is_refused_in_a_sentence(
    dive: Path, asked: str, said: str
) -> None:
    with pytest.raises(AquaFlowError, match=said):
        show_in(Dive(dive), asked)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--format", "ortho", "--water"], "as the camera saw them; leave --white-balance out"),
        (["--format", "colmap"], "as the camera saw them; leave --white-balance out"),
        (["--format", "dem"], "--format dem knows no --white-balance"),
    ],
)
def test_what_shows_no_restored_colours_has_no_white_balance(
    dive: Path, options: list[str], said: str
) -> None:
    result = CliRunner().invoke(app, ["export", str(dive), *options, "--white-balance", "neutral"])
    assert result.exit_code == 1
    assert said in str(result.exception)


def test_water_that_was_never_fitted_or_is_not_there_has_no_other_white_balance(
    dive: Path,
) -> None:
    mapper = mapped()
    mapper.scene.balance = None
    write_map_file(dive / "map.aqf", mapper)
    with pytest.raises(InputError, match="never fitted"):
        show_in(Dive(dive), "neutral")
    mapper.medium.active = False
    write_map_file(dive / "map.aqf", mapper)
    with pytest.raises(InputError, match="no water to remove"):
        show_in(Dive(dive), "neutral")


def test_a_dive_of_which_nothing_was_restored_is_not_neutral(dive: Path) -> None:
    mapper = mapped()
    mapper.medium.set_water(*(torch.tensor(v) for v in ((9.0,) * 3, (0.2,) * 3, (5.0,) * 3)))
    write_map_file(dive / "map.aqf", mapper)
    with pytest.raises(InputError, match=r"too little of .* was restored to say what is neutral"):
        show_in(Dive(dive), "neutral")


def test_a_pixel_where_nothing_was_restored_is_not_grey(dive: Path) -> None:
    mapper = mapped()
    keep = mapper.gaussians.parameters["means"][:, 0] > 0.0
    mapper.gaussians.parameters["opacity_logits"][~keep] = -20.0
    write_map_file(dive / "map.aqf", mapper)
    with pytest.raises(InputError, match="nothing was restored at 8,20 of frame 0"):
        show_in(Dive(dive), "0:8,20")
