"""metric.json: read back as written, and refused with a sentence where it is damaged."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.telemetry.metric_file import (
    NAME,
    read_frame_of_map,
    read_metric_file,
    write_metric_file,
)
from aquaflow.telemetry.world_frame import WorldFrame
from tests.metric_scenes import metric_frame


def written(folder: Path) -> dict[int, WorldFrame]:
    on_ground = replace(WorldFrame.unknown(), on_ground=True)
    frames = {0: WorldFrame.unknown(), 1: on_ground, 2: metric_frame()}
    write_metric_file(folder, frames, main=2)
    return frames


def test_frames_are_read_back_as_they_were(tmp_path: Path) -> None:
    for number, frame in written(tmp_path).items():
        back = read_metric_file(tmp_path)[number]
        np.testing.assert_array_equal(back.covariance, frame.covariance)
        np.testing.assert_array_equal(back.T_nm.matrix, frame.T_nm.matrix)
        assert (back.T_bc is None) == (frame.T_bc is None)
        for name in (
            "metric",
            "level",
            "on_ground",
            "north",
            "depth_known",
            "origin",
            "scale_source",
            "sources",
        ):
            assert getattr(back, name) == getattr(frame, name)


def test_flags_may_be_numpys(tmp_path: Path) -> None:
    yes = np.float64(0.1) <= np.float64(0.2)
    frame = metric_frame(metric=yes, level=yes, depth_known=yes)
    write_metric_file(tmp_path, {0: frame}, main=0)
    assert read_metric_file(tmp_path)[0].level is True


def test_a_map_file_has_the_frame_of_its_sub_map(tmp_path: Path) -> None:
    written(tmp_path)
    assert read_frame_of_map(tmp_path / "map.aqf").metric
    assert not read_frame_of_map(tmp_path / "map_0.aqf").metric


def test_a_dive_without_the_file_is_in_map_units(tmp_path: Path) -> None:
    assert read_metric_file(tmp_path) == {}
    assert read_frame_of_map(tmp_path / "map.aqf").is_identity


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("covariance",), [[1.0]], "a covariance is not 7 x 7"),
        (("T_nm", "scale"), -1.0, "a transform is not finite"),
        (("T_nm", "rotation"), [[2.0, 0, 0], [0, 1, 0], [0, 0, 1]], "a transform's rotation"),
        (("north",), "secret", "north is none of the words"),
        (("sources",), [{"password": 1}], "cannot read"),
        (("T_bc",), {}, "key 'rotation' is missing"),
    ],
)
def test_a_damaged_file_is_refused_without_its_content(
    tmp_path: Path, path: tuple[str, ...], value: object, said: str
) -> None:
    written(tmp_path)
    data = json.loads((tmp_path / NAME).read_text())
    place = data["sub_maps"]["2"]
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    (tmp_path / NAME).write_text(json.dumps(data))
    with pytest.raises(InputError, match=said) as refused:
        read_metric_file(tmp_path)
    assert "secret" not in str(refused.value)
    assert "password" not in str(refused.value)


def test_a_newer_format_and_no_json_are_refused(tmp_path: Path) -> None:
    (tmp_path / NAME).write_text('{"format": 99}')
    with pytest.raises(InputError, match="update AquaFlow"):
        read_metric_file(tmp_path)
    for text in ("[]", '{"format": "secret"}', "{}", "no JSON"):
        (tmp_path / NAME).write_text(text)
        with pytest.raises(InputError, match="map the dive again") as refused:
            read_metric_file(tmp_path)
        assert "secret" not in str(refused.value)
