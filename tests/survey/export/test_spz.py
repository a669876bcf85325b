"""SPZ files, decoded by what the specification says; every error is within its quantisation."""

from __future__ import annotations

import gzip
import json
import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from aquaflow.cli import app
from aquaflow.dive.dive import Dive
from aquaflow.dive.ply import SH_C0, PlyGaussians, read_ply
from aquaflow.survey.export import spz
from aquaflow.survey.export.spz import export_spz, fraction_bits, write_spz
from tests.survey.export.small_dive import north_up_frame, write_small_dive

Array = npt.NDArray[np.float64]

LARGEST_TURN_DEG = float(np.degrees(2.0 * np.sqrt(12.0) * 0.5 / (511.0 * np.sqrt(2.0))))
"""Half a step in each of three components, and what that makes of the largest where all are 1/2."""


def random_splats(count: int = 3000, reach: float = 50.0) -> PlyGaussians:
    rng = np.random.default_rng(3)
    return PlyGaussians(
        means=rng.uniform(-reach, reach, (count, 3)),
        wxyz=rng.normal(size=(count, 4)),
        scales=np.exp(rng.uniform(-9.0, 3.0, (count, 3))),
        opacities=rng.uniform(0.0, 1.0, count),
        colours=rng.uniform(-0.2, 1.2, (count, 3)),
    )


def decoded(path: Path) -> PlyGaussians:
    """A file of version 3 without harmonics, by the README of nianticlabs/spz; a loop for each
    rotation, unlike the encoder."""
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<3I4B", data)
    assert (magic, version, degree, flags, reserved) == (0x5053474E, 3, 0, 0, 0)
    assert len(data) == 16 + count * (9 + 1 + 3 + 3 + 4)
    sizes = [9 * count, count, 3 * count, 3 * count, 4 * count]
    starts = 16 + np.cumsum([0, *sizes])
    parts = [data[a:b] for a, b in pairwise(starts)]
    means = [
        int.from_bytes(parts[0][at : at + 3], "little", signed=True) / 2**bits
        for at in range(0, 9 * count, 3)
    ]
    alphas, colours, scales = (np.frombuffer(part, np.uint8).astype(float) for part in parts[1:4])
    wxyz = [rotation(number) for (number,) in struct.iter_unpack("<I", parts[4])]
    harmonics = (colours / 255.0 - 0.5) / 0.15
    return PlyGaussians(
        np.reshape(means, (-1, 3)), np.array(wxyz), np.exp(scales / 16.0 - 10.0).reshape(-1, 3),
        alphas / 255.0, (0.5 + SH_C0 * harmonics).reshape(-1, 3),
    )  # fmt: skip


def rotation(number: int) -> list[float]:
    """wxyz of 2 bits that name the largest of x, y, z, w, and 10 bits for each other."""
    largest, xyzw = number >> 30, [0.0, 0.0, 0.0, 0.0]
    for index in (3, 2, 1, 0):
        if index != largest:
            size, is_negative = number & 511, number >> 9 & 1
            number >>= 10
            xyzw[index] = (-1.0 if is_negative else 1.0) * size / 511.0 / np.sqrt(2.0)
    xyzw[largest] = np.sqrt(1.0 - sum(value**2 for value in xyzw))
    return [xyzw[3], *xyzw[:3]]


def angles_deg(
    first: Array,  # [N, 4] wxyz
    second: Array,  # [N, 4] wxyz
) -> Array:
    """[N] between two rotations."""
    turns = Rotation.from_quat(first, scalar_first=True).inv() * Rotation.from_quat(
        second, scalar_first=True
    )
    return np.asarray(np.degrees(turns.magnitude()))


def test_what_is_decoded_is_within_half_a_step_of_what_was_written(tmp_path: Path) -> None:
    splats = random_splats()
    write_spz(tmp_path / "a.spz", splats)
    found = decoded(tmp_path / "a.spz")
    assert np.abs(found.means - splats.means).max() <= 0.5 / 2**12
    assert np.abs(np.log(found.scales / splats.scales)).max() <= 0.5 / 16.0 + 1e-9
    assert np.abs(found.opacities - splats.opacities).max() <= 0.5 / 255.0 + 1e-9
    assert np.abs(found.colours - splats.colours).max() <= 0.5 / 255.0 * SH_C0 / 0.15 + 1e-9
    assert angles_deg(found.wxyz, splats.wxyz).max() < LARGEST_TURN_DEG


def test_a_far_gaussian_costs_resolution_and_is_not_folded_back(tmp_path: Path) -> None:
    splats = random_splats(count=10, reach=3000.0)
    splats.means[0] = [5000.0, -5000.0, 0.0]
    assert fraction_bits(5000.0) == 10
    write_spz(tmp_path / "a.spz", splats)
    assert np.abs(decoded(tmp_path / "a.spz").means - splats.means).max() <= 0.5 / 2**10


def test_what_no_byte_can_say_is_cut_off(tmp_path: Path) -> None:
    splats = random_splats(count=2)
    splats.scales[:] = [[1e-9, 1e9, 1.0], [1.0, 1.0, 1.0]]
    splats.colours[:] = [[9.0, -9.0, 0.5], [0.5, 0.5, 0.5]]
    write_spz(tmp_path / "a.spz", splats)
    found = decoded(tmp_path / "a.spz")
    np.testing.assert_allclose(np.log(found.scales[0, :2]), [-10.0, 255.0 / 16.0 - 10.0])
    np.testing.assert_allclose(found.colours[0, :2], 0.5 + np.array([1, -1]) * SH_C0 * 0.5 / 0.15)


def test_chunks_change_nothing_and_the_same_map_gives_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_spz(tmp_path / "a.spz", random_splats())
    monkeypatch.setattr(spz, "CHUNK", 97)
    write_spz(tmp_path / "b.spz", random_splats())
    assert (
        decoded(tmp_path / "a.spz").means.tobytes() == decoded(tmp_path / "b.spz").means.tobytes()
    )
    write_spz(tmp_path / "c.spz", random_splats())
    assert (tmp_path / "b.spz").read_bytes() == (tmp_path / "c.spz").read_bytes()


def test_an_empty_map_is_a_header_alone(tmp_path: Path) -> None:
    write_spz(tmp_path / "a.spz", random_splats(count=0))
    assert len(decoded(tmp_path / "a.spz").means) == 0


def test_a_dive_is_upright_in_a_viewer_whose_y_is_up(tmp_path: Path) -> None:
    write_small_dive(tmp_path / "dive", north_up_frame())
    count, _ = export_spz(Dive(tmp_path / "dive"), tmp_path / "a.spz")
    found = decoded(tmp_path / "a.spz")
    north, east, down = read_ply(tmp_path / "dive" / "map_clear.ply").means.T
    np.testing.assert_allclose(found.means, np.stack([east, -down, -north], axis=1), atol=2e-4)
    thin = Rotation.from_quat(found.wxyz, scalar_first=True).as_matrix()[:, :, 2]
    np.testing.assert_allclose(np.abs(thin[:, 1]), 1.0, atol=1e-4)  # flat Gaussians lie flat
    assert count == len(found.means) == 1200


def test_the_command_writes_the_clear_map_or_the_one_in_water(tmp_path: Path) -> None:
    dive = tmp_path / "dive"
    write_small_dive(dive)
    for extra, name in ((), "map_clear.ply"), (("--water",), "map.ply"):
        result = CliRunner().invoke(app, ["export", str(dive), "--format", "spz", *extra, "--json"])
        assert result.exit_code == 0, result.output
        said = json.loads(result.output)
        assert (said["out"], said["gaussians"]) == (str(dive / "map.spz"), 1200)
        assert said["unit"] == "map units"
        found = decoded(dive / "map.spz").colours
        assert np.abs(found - read_ply(dive / name).colours).max() < 0.004
