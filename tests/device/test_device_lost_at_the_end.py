"""A device that fails while a finished dive is evaluated and written costs none of its files."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from aquaflow.config import Config
from aquaflow.dive.deliverables import Deliverables
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.map_file import read_map_file
from aquaflow.mapping.maps import Maps
from aquaflow.render.contract import CPU
from aquaflow.render.reference import ReferenceRenderer
from aquaflow.tracking.frames import FrameClass, Tracked
from tests.device.device_scenes import assert_alike, on_host
from tests.device.failing_dives import copy_of, dive, growth
from tests.live.live_scenes import frame_of
from tests.pretended_device import PRETENDED, Device

pytestmark = [pytest.mark.usefixtures("nothing_strays", "repaired"), pytest.mark.ci]

FILES = ("map.aqf", "map.ply", "map_clear.ply")


@cache
def once_refined() -> Maps:
    maps = dive(decoder=True, views=3)
    maps.refine()
    assert maps.renderer.device == PRETENDED
    return maps


def refined() -> Maps:
    """A dive with a decoder that was refined on the device, and a view held out."""
    maps = copy_of(once_refined())
    maps.hold_out(growth(3).view, 0)
    return maps


def delivered(maps: Maps, folder: Path, between: Callable[[], None] = lambda: None) -> Deliverables:
    """The dive evaluated, and its map written; ``between`` happens before writing."""
    slam: Any = SimpleNamespace(
        maps=maps, mappers=maps.mappers, held_out=maps.held_out, failures=maps.failures
    )
    dive_folder = DiveFolder(folder, Config())
    tracked = [
        Tracked(frame_of(view.frame_index), FrameClass.MAPPING, 0, 0, view.T_wc)
        for view in maps.mappers[0].views
    ]
    made = Deliverables("small", dive_folder, slam, tracked, None)
    made.evaluate()
    between()
    made._write_map(0)
    dive_folder.close()
    return made


@pytest.fixture(scope="module")
def undisturbed(device: Device, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    folder = tmp_path_factory.mktemp("undisturbed") / "dive"
    made = delivered(refined(), folder)
    return folder, made.held_out[0].psnr


@pytest.mark.parametrize(
    ("when", "lost"), [("evaluation", True), ("evaluation", False), ("writing", True)]
)
def test_what_was_refined_is_evaluated_and_written_on_the_cpu(
    device: Device, undisturbed: tuple[Path, float], tmp_path: Path, when: str, lost: bool
) -> None:
    maps = refined()

    def fail() -> None:
        device.fails_at, device.lost = device.calls + 50, lost

    if when == "evaluation":
        fail()
    made = delivered(maps, tmp_path / "dive", fail if when == "writing" else lambda: None)
    assert maps.renderer.device == CPU
    assert maps.failures.of_device > 0
    folder, psnr = undisturbed
    assert made.held_out[0].psnr == pytest.approx(psnr, rel=1e-3)
    files = [folder / "map.aqf", tmp_path / "dive" / "map.aqf"]
    wanted, got = (on_host(read_map_file(file, ReferenceRenderer())) for file in files)
    assert_alike(got, wanted)
    for name in FILES[1:]:
        assert (tmp_path / "dive" / name).stat().st_size == (folder / name).stat().st_size


def test_a_device_that_works_is_left_alone(device: Device, undisturbed: tuple[Path, float]) -> None:
    maps = refined()
    assert not maps.failures.kinds
    assert maps.leave_device("in a test")
    assert maps.renderer.device == maps.mappers[0].device == CPU
    assert not maps.leave_device("in a test")
