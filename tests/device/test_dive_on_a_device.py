"""A dive mapped on a device is that of the CPU; so is all that is made of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from aquaflow.api.map import load_map
from aquaflow.base.storage.archive import read_facts_file
from aquaflow.dive.dive import Dive
from aquaflow.dive.map_file import read_map_file
from aquaflow.dive.ply import read_ply
from aquaflow.dive.restored import export_restored
from aquaflow.lab.bench.scene import BenchmarkScene
from aquaflow.lab.bench.worker import measure_errors
from aquaflow.render.contract import CPU
from aquaflow.survey.measure.scale_bar import between_pixels
from tests.device.device_scenes import WHERE, counted
from tests.device.gsplats_place import KernelsOfTheDevice, machine_with
from tests.device.whole_dives import map_on, write_dimmed_dive
from tests.pretended_device import PRETENDED, Device

MAPPED = 5
"""A frame that is in the map."""
NEAR = 1e-3
"""Relative: torch rounds its gradients otherwise for tensors of a subclass, by the processor, and
steps of the optimiser make that larger."""


@dataclass
class Dives:
    """One recording, mapped on the CPU and on the device."""

    recording: Path
    folders: list[Path] = field(default_factory=list)
    metrics: list[dict[str, Any]] = field(default_factory=list)


@contextmanager
def only_named(device: Device) -> Iterator[None]:
    """Tensors are moved, and by the named functions alone."""
    began, named = counted(), device.named
    yield
    assert not device.strays
    assert device.named - named == counted() - began > 0


@pytest.fixture(scope="module")
def dives(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Dives:
    root = tmp_path_factory.mktemp("dives")
    dives = Dives(write_dimmed_dive(root))
    for where in WHERE:
        folder, before = root / where.type, device.calls
        if where == CPU:
            finished = map_on(where, dives.recording, folder)
            assert device.calls == before
        else:
            with only_named(device):
                finished = map_on(where, dives.recording, folder)
        dives.folders.append(folder)
        dives.metrics.append(finished.metrics)
    return dives


def assert_same_pictures(got: Path, wanted: Path, at_least: int) -> None:
    """The same files, the same pictures within one grey level."""
    names = sorted(path.name for path in wanted.glob("*.png"))
    assert len(names) >= at_least
    assert sorted(path.name for path in got.glob("*.png")) == names
    for name in names:
        a, b = (cv2.imread(str(each / name), cv2.IMREAD_UNCHANGED) for each in (got, wanted))
        assert a is not None
        assert b is not None
        np.testing.assert_allclose(a.astype(int), b.astype(int), atol=1, err_msg=name)


def test_its_map_is_the_same_in_every_format(dives: Dives) -> None:
    on_cpu, away = dives.folders
    got, wanted = (read_facts_file(each / "map.aqf")[1] for each in (away, on_cpu))
    assert got.keys() == wanted.keys()
    for name, array in wanted.items():
        np.testing.assert_allclose(got[name], array, rtol=NEAR, atol=NEAR, err_msg=name)
    for file in ("map.ply", "map_clear.ply"):
        splats, expected = (read_ply(each / file) for each in (away, on_cpu))
        assert len(splats.means) > 500
        for name, array in vars(expected).items():
            np.testing.assert_allclose(getattr(splats, name), array, rtol=NEAR, atol=NEAR)
    paths = [np.loadtxt(each / "trajectory.tum") for each in (away, on_cpu)]
    np.testing.assert_allclose(*paths, atol=NEAR)
    assert (away / "frames.csv").read_bytes() == (on_cpu / "frames.csv").read_bytes()
    assert_same_pictures(away / "heldout", on_cpu / "heldout", 2)


def test_it_says_where_it_was_mapped_and_what_was_moved(dives: Dives) -> None:
    on_cpu, away = dives.metrics
    for key in ("gaussians", "steps", "tracked", "heldout_frames", "failures"):
        assert away[key] == on_cpu[key], key
    for key in ("psnr", "ssim"):
        assert away[key] == pytest.approx(on_cpu[key], rel=NEAR)
    assert not away["failures"]
    assert (on_cpu["device"], away["device"]) == (CPU.type, PRETENDED.type)
    assert away["renderer"].startswith("gsplat")


def test_the_dive_has_all_that_a_map_can_have(dives: Dives, device: Device) -> None:
    mapper = read_map_file(dives.folders[1] / "map.aqf", KernelsOfTheDevice())
    assert mapper.medium.active
    assert mapper.neural is not None
    assert mapper.scene.exposes
    assert any(bool(view.log_gain.any()) for view in mapper.views)
    assert mapper.gaussians.means.device == PRETENDED


def test_its_errors_are_the_same(dives: Dives) -> None:
    scene = BenchmarkScene("small", str(dives.recording), str(dives.recording))
    on_cpu, away = (measure_errors(scene, folder) for folder in dives.folders)
    for key in ("ate_pct_sim3", "depth_absrel"):
        assert away[key] == pytest.approx(on_cpu[key], rel=10.0 * NEAR)


@pytest.mark.parametrize("with_pictures", [False, True])
def test_its_restored_frames_are_the_same(
    dives: Dives, device: Device, with_pictures: bool, tmp_path: Path
) -> None:
    for where, folder in zip(WHERE, dives.folders, strict=True):
        with machine_with(where):
            recording = dives.recording if with_pictures else None
            export_restored(Dive(folder), tmp_path / where.type, recording)
    assert_same_pictures(tmp_path / PRETENDED.type, tmp_path / CPU.type, 8)
    assert not device.strays


def test_programs_read_the_same_from_it(dives: Dives, device: Device) -> None:
    maps = []
    for where, folder in zip(WHERE, dives.folders, strict=True):
        with machine_with(where):
            maps.append(load_map(folder))
    on_cpu, away = maps
    wanted, got = (each.render(on_cpu.views[0].T_wc) for each in maps)
    np.testing.assert_allclose(got.image, wanted.image, atol=10.0 * NEAR)
    np.testing.assert_allclose(got.clean, wanted.clean, atol=10.0 * NEAR)
    np.testing.assert_allclose(away.gaussians.means, on_cpu.gaussians.means, atol=NEAR)
    assert away.medium is not None
    assert on_cpu.medium is not None
    np.testing.assert_allclose(away.medium.beta_a, on_cpu.medium.beta_a, rtol=10.0 * NEAR)
    assert not device.strays


def test_a_scale_bar_in_it_is_as_long(dives: Dives, device: Device) -> None:
    lengths = []
    for where, folder in zip(WHERE, dives.folders, strict=True):
        with machine_with(where):
            bar = between_pixels(Dive(folder), MAPPED, (30.0, 30.0), (60.0, 45.0), 1.0, 0.01)
        lengths.append(bar.map_length)
    assert lengths[1] == pytest.approx(lengths[0], rel=10.0 * NEAR)
    assert not device.strays
