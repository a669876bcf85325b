"""Points of a dive as E57: read back by pye57, compared with the same points as LAZ has them."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from typer.testing import CliRunner

from aquaflow.base.errors import InputError
from aquaflow.cli import app
from aquaflow.dive import point_cloud
from aquaflow.dive.dive import Dive
from aquaflow.dive.point_cloud import CloudPoints, read_point_cloud
from aquaflow.survey.export.point_clouds import COLOURS, NORMALS, POSITIONS, SIGMA, write_e57
from tests.survey.export.small_dive import north_up_frame, write_small_dive

pye57 = pytest.importorskip("pye57", reason="pye57 has no wheel for this machine")


@pytest.fixture
def dive(tmp_path: Path) -> Path:
    write_small_dive(tmp_path / "dive", north_up_frame())
    return tmp_path / "dive"


def all_points(dive: Path) -> CloudPoints:
    (points,) = read_point_cloud(Dive(dive)).chunks()
    return points


def fields(path: Path, names: tuple[str, ...]) -> dict[str, npt.NDArray[Any]]:
    """Fields of the first scan by libE57Format itself: pye57's reader knows no extensions."""
    with pye57.E57(str(path)) as file:
        scan = file.get_header(0)
        columns = {name: np.zeros(scan.point_count, np.float32) for name in names}
        buffers = pye57.libe57.VectorSourceDestBuffer()
        for name, column in columns.items():
            buffers.append(
                pye57.libe57.SourceDestBuffer(
                    file.image_file, name, column, scan.point_count, True, True
                )
            )
        scan.points.reader(buffers).read()
    return columns


def test_positions_are_on_the_grid_to_a_tenth_of_a_millimetre(dive: Path, tmp_path: Path) -> None:
    write_e57(tmp_path / "a.e57", read_point_cloud(Dive(dive)))
    with pye57.E57(str(tmp_path / "a.e57")) as file:
        found = file.read_scan(0, colors=True, ignore_missing_fields=True)
    points, where = all_points(dive), read_point_cloud(Dive(dive)).placement
    expected = where.on_grid(points.positions)
    assert expected[:, 1].min() > 6e6  # northing at 59 degrees
    assert np.abs(np.stack([found[name] for name in POSITIONS], axis=1) - expected).max() < 1e-4
    np.testing.assert_array_equal(
        np.stack([found[name] for name in COLOURS], axis=1), points.colours
    )


def test_normals_and_sigma_are_there_as_extensions(dive: Path, tmp_path: Path) -> None:
    write_e57(tmp_path / "a.e57", read_point_cloud(Dive(dive)))
    found = fields(tmp_path / "a.e57", (*NORMALS, SIGMA))
    normals = np.stack([found[name] for name in NORMALS], axis=1)
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, 1.0], (1200, 1)), atol=1e-6)
    np.testing.assert_allclose(found[SIGMA], all_points(dive).sigma, rtol=1e-6)


def test_the_file_names_its_grid_or_its_unit(dive: Path, tmp_path: Path) -> None:
    write_e57(tmp_path / "a.e57", read_point_cloud(Dive(dive)))
    write_small_dive(tmp_path / "other")
    write_e57(tmp_path / "b.e57", read_point_cloud(Dive(tmp_path / "other")))
    said = {}
    for name in ("a", "b"):
        with pye57.E57(str(tmp_path / f"{name}.e57")) as file:
            wkt = file.root["coordinateMetadata"].value()
            said[name] = (wkt, file.data3d[0]["description"].value())
    assert said["a"][0].startswith("PROJCS[")
    assert "EPSG:32632" in said["a"][1]
    assert said["b"][0] == ""
    assert said["b"][1].endswith("map units")


def test_chunks_change_nothing(dive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = (*POSITIONS, *NORMALS, SIGMA)
    write_e57(tmp_path / "a.e57", read_point_cloud(Dive(dive)))
    monkeypatch.setattr(point_cloud, "CHUNK", 97)
    steps: list[tuple[int, int]] = []
    write_e57(tmp_path / "b.e57", read_point_cloud(Dive(dive)), lambda *step: steps.append(step))
    whole, parts = (fields(tmp_path / f"{name}.e57", names) for name in ("a", "b"))
    for name in names:
        np.testing.assert_array_equal(whole[name], parts[name])
    assert steps[-1] == (1200, 1200)


def test_a_missing_package_is_named_with_what_installs_it(
    dive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(InputError, match="an E57 file needs the library pye57"):
        write_e57(tmp_path / "a.e57", read_point_cloud(Dive(dive)))
    assert not list(tmp_path.glob("*.e57"))


def test_what_the_library_cannot_write_is_one_sentence(dive: Path, tmp_path: Path) -> None:
    cloud = read_point_cloud(Dive(dive))

    def disk_is_full(done: int, total: int) -> None:
        raise pye57.libe57.E57Exception("the disk is full")

    with pytest.raises(InputError, match=r"cannot write .*a\.e57: .*; give a folder with room"):
        write_e57(tmp_path / "a.e57", cloud, disk_is_full)
    assert not list(tmp_path.glob("*.e57"))


def test_the_command_writes_into_the_dive(dive: Path) -> None:
    result = CliRunner().invoke(app, ["export", str(dive), "--format", "e57", "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.output)["out"] == str(dive / "points.e57")
    assert (dive / "points.e57").stat().st_size > 1200 * 20
