"""The exact map: what comes back looks, and goes on learning, bit for bit as what was written."""

from __future__ import annotations

import copy
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from aquaflow.base.errors import InputError
from aquaflow.base.storage.archive import FACTS
from aquaflow.dive.map_file import read_map_file, write_map_file
from aquaflow.mapping.mapper import Mapper
from tests.mapping.mapping_scenes import (
    copied,
    filmed,
    flat_pointmap,
    floor,
    grown,
    path,
    renderer,
    same,
    settings,
)

PLAIN: dict[str, Any] = {"optimiser": {"refine_steps": 6}}
KINDS = {
    "dry": {},
    "through water": {"medium": {"enabled": True}},
    "neural": {"decoder": {"enabled": True}},
}
OTHERS = {name: change for name, change in KINDS.items() if name != "dry"}


def learned(kind: str = "dry") -> Mapper:
    """A map with all that a file must hold."""
    mapper = grown(settings(**copy.deepcopy({**PLAIN, **KINDS[kind]})))
    mapper.optimise(6)
    mapper.scene.shading = np.array([0.0, 0.1, -0.1, 0.0, 0.05])
    mapper.scene.exposes, mapper.scene.sunlight.columns = True, 12
    for i, view in enumerate(mapper.views):
        view.log_gain = torch.tensor([0.01, 0.0, -0.02], dtype=torch.float64) * i
    mapper.refine()
    return mapper


def with_pictures(mapper: Mapper) -> Mapper:
    """The views of ``grown`` have their pixels again."""
    for view, original in zip(mapper.views, filmed(floor(), path(4)), strict=True):
        view.move_pixels({})  # type: ignore[arg-type]
        view._store = original._store
        view.inverse_range = view.range_confidence = None
    return mapper


@pytest.mark.parametrize("kind", KINDS)
def test_a_map_that_was_read_back_renders_the_same_bits(kind: str, tmp_path: Path) -> None:
    mapper, file = learned(kind), tmp_path / "map.aqf"
    before = [mapper.show(view) for view in mapper.views]
    write_map_file(file, mapper)
    read = read_map_file(file, renderer())
    assert len(read.views) == len(mapper.views)
    for view, old in zip(read.views, before, strict=True):
        shown = read.show(view)
        assert torch.equal(shown.image, old.image)
        assert torch.equal(shown.z, old.z)
    assert torch.equal(read.gaussians.keyframes, mapper.gaussians.keyframes)
    assert read.config == mapper.config


@pytest.mark.parametrize("kind", KINDS)
def test_with_its_optimiser_it_goes_on_as_if_it_had_never_been_away(
    kind: str, tmp_path: Path
) -> None:
    mapper, file = learned(kind), tmp_path / "map.aqf"
    write_map_file(file, mapper, optimiser=True)
    read = read_map_file(file, renderer())
    for each in (with_pictures(mapper), with_pictures(read)):
        each.optimise(5)
        each.insert(each.views[1], flat_pointmap(depth=1.5))
        each.optimise(5)
        each.refine()
    assert same(copied(mapper), copied(read))
    assert read.steps == mapper.steps


def test_a_baked_map_needs_no_decoder(tmp_path: Path) -> None:
    mapper, file = learned("neural"), tmp_path / "map.aqf"
    mapper.scene.bake(mapper.views)
    write_map_file(file, mapper)
    read = read_map_file(file, renderer())
    assert read.neural is None
    assert same(copied(read), copied(mapper))


def test_an_empty_map_is_a_map(tmp_path: Path) -> None:
    write_map_file(tmp_path / "map.aqf", Mapper(settings(), renderer(), 0))
    assert len(read_map_file(tmp_path / "map.aqf", renderer()).gaussians) == 0


def test_the_same_map_gives_the_same_file(tmp_path: Path) -> None:
    mapper = learned()
    for name in ("a", "b"):
        write_map_file(tmp_path / name, mapper, optimiser=True)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


# --- what is no map -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    file = tmp_path_factory.mktemp("map") / "map.aqf"
    write_map_file(file, learned())
    return file.read_bytes()


def refusal(content: bytes, folder: Path) -> str:
    file = folder / "map.aqf"
    file.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_map_file(file, renderer())
    said = str(caught.value)
    assert str(file) in said
    assert "\n" not in said
    return said


def changed(content: bytes, **facts: object) -> bytes:
    """The same file with other facts."""
    with np.load(io.BytesIO(content)) as file:
        arrays = {name: file[name] for name in file.files}
    told = {**json.loads(arrays[FACTS].tobytes()), **facts}
    arrays[FACTS] = np.frombuffer(json.dumps(told).encode(), np.uint8)
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_file_that_was_cut_off_is_refused(content: bytes, share: float, tmp_path: Path) -> None:
    refusal(content[: int(share * len(content))], tmp_path)


def test_a_file_with_a_wrong_byte_is_refused_wherever_it_matters(
    content: bytes, tmp_path: Path
) -> None:
    (tmp_path / "whole.aqf").write_bytes(content)
    whole = copied(read_map_file(tmp_path / "whole.aqf", renderer()))
    refused = 0
    for place in np.random.default_rng(0).integers(0, len(content), 40):
        damaged = bytearray(content)
        damaged[place] ^= 0x55
        (tmp_path / "map.aqf").write_bytes(damaged)
        try:
            read = read_map_file(tmp_path / "map.aqf", renderer())
        except InputError as error:
            refused += "\n" not in str(error)
        else:  # in what a zip says twice
            assert same(copied(read), whole)
    assert refused > 20


def test_a_newer_format_asks_for_an_update(content: bytes, tmp_path: Path) -> None:
    assert "update" in refusal(changed(content, format=99), tmp_path)


@pytest.mark.parametrize(
    "facts", [{"kind": "other"}, {"config": {"no": 1}}, {"cameras": []}, {"optimiser": True}]
)
def test_facts_that_fit_no_map_are_refused(
    content: bytes, facts: dict[str, object], tmp_path: Path
) -> None:
    refusal(changed(content, **facts), tmp_path)


def test_no_file_and_no_room_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read the map"):
        read_map_file(tmp_path / "none.aqf", renderer())
    with pytest.raises(InputError, match="cannot write"):
        write_map_file(tmp_path / "no folder" / "map.aqf", learned())


def test_a_map_that_is_not_finite_is_not_written(tmp_path: Path) -> None:
    mapper = grown(settings())
    mapper.gaussians.means[0, 0] = torch.nan
    with pytest.raises(ArithmeticError, match="means of the map is not finite"):
        write_map_file(tmp_path / "map.aqf", mapper)
    assert not list(tmp_path.iterdir())
