"""Chunks of bytes: what a browser reads from them is what was packed, most contributing first."""

from __future__ import annotations

import gzip
from typing import Any

import numpy as np
import pytest

from aquaflow.survey.viewer.levels import range_level
from aquaflow.survey.viewer.packing import FIRST_CHUNK, Packed, chunk_ends, contract
from aquaflow.survey.viewer.seen_water import water_of
from aquaflow.survey.viewer.splats import ViewerSplats, splats

RNG = np.random.default_rng(3)


def random(count: int) -> ViewerSplats:
    means = RNG.normal(size=(count, 3)).astype(np.float32)
    means[0] = (0.0, 0.0, 5000.0)  # one far away
    return splats(
        means,
        RNG.normal(size=(count, 4)).astype(np.float32),
        np.exp(RNG.normal(-3.0, 0.5, (count, 3))).astype(np.float32),
        RNG.uniform(0.1, 1.0, count).astype(np.float32),
        RNG.uniform(0.0, 1.3, (count, 3)).astype(np.float32),
        count,
        {"seen": RNG.integers(0, 255, count).astype(np.uint8)},
    )


def unpacked(packed: Packed) -> dict[str, Any]:
    """As the page's load.js and shader read it."""
    about = packed.description()
    parts: list[dict[str, Any]] = []
    first = 0
    for number, end in enumerate(about["ends"]):
        chunk = packed.chunk(number)
        assert chunk is not None
        raw, count = gzip.decompress(chunk), end - first
        u = np.frombuffer(raw, "<u2", 3 * count).reshape(3, count).T * (4.0 / 65535.0) - 2.0
        far = np.minimum(np.abs(u), 1.9999)
        inside = np.where(far < 1.0, u, np.sign(u) / (2.0 - far))
        rest = np.frombuffer(raw, np.uint8, offset=6 * count).reshape(-1, count).T
        low, high = about["log_scales"]
        parts.append(
            {
                "centres": np.array(about["middle"]) + np.array(about["half"]) * inside,
                "wxyz": rest[:, :4].view(np.int8) / 127.0,
                "scales": np.exp(low + rest[:, 4:7] / 255.0 * (high - low)),
                "opacities": rest[:, 7] / 255.0,
                "colours": rest[:, 8:11] / 255.0 * about["brightest"],
                "seen": rest[:, 11],
            }
        )
        first = end
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def test_a_browser_reads_what_was_packed() -> None:
    shown = random(3 * FIRST_CHUNK)
    read = unpacked(Packed(shown))
    inner = np.abs(shown.centres).max(axis=1) < 2.0
    assert np.abs(read["centres"] - shown.centres)[inner].max() < 3e-4
    wrong = np.abs(read["scales"] / shown.scales - 1.0) > 0.05
    assert wrong.mean() < 0.002  # of the smallest, which are drawn as the smallest
    same = np.abs((read["wxyz"] * shown.wxyz).sum(axis=1)) / np.linalg.norm(read["wxyz"], axis=1)
    assert same.min() > 0.9999
    assert np.allclose(read["opacities"], shown.opacities, atol=0.003)
    assert np.abs(read["colours"] - shown.colours).mean() < 0.003
    assert (read["seen"] == shown.levels["seen"]).all()


def test_one_far_away_costs_the_others_no_precision_and_stays_far() -> None:
    shown = random(1000)
    far = int(np.argmax(shown.centres[:, 2]))
    read = unpacked(Packed(shown))["centres"]
    assert read[far, 2] > 1000.0
    assert np.median(np.abs(np.delete(read - shown.centres, far, axis=0))) < 1e-4


def test_the_first_chunk_is_small_and_holds_what_covers_most() -> None:
    packed = Packed(random(3 * FIRST_CHUNK))
    about = packed.description()
    assert about["ends"] == [FIRST_CHUNK, 2 * FIRST_CHUNK, 3 * FIRST_CHUNK]
    assert about["covered"][0] > 1.0 / 3.0
    assert np.isclose(about["covered"][-1], 1.0)
    first = packed.chunk(0)
    assert first is not None
    assert len(first) < 18 * FIRST_CHUNK


@pytest.mark.parametrize("count", [0, 1, FIRST_CHUNK, FIRST_CHUNK + 1, 500_000])
def test_chunks_cover_all_and_begin_at_rows_of_the_texture(count: int) -> None:
    ends = chunk_ends(count)
    assert ([0, *ends])[-1] == count
    assert ends == sorted(set(ends))
    assert all(end % 1024 == 0 for end in ends[:-1])


def test_there_is_no_chunk_beyond_the_last() -> None:
    packed = Packed(random(10))
    assert packed.chunk(1) is None
    assert packed.chunk(-1) is None


def test_an_empty_map_has_no_chunks() -> None:
    packed = Packed(random(10).among(np.zeros(10, bool)))
    assert packed.description()["ends"] == []


def test_the_same_map_has_the_same_address_and_another_one_another() -> None:
    shown = random(100)
    assert Packed(shown).version == Packed(shown).version
    assert Packed(shown).version != Packed(shown.among(np.arange(100) > 0)).version


def test_positions_are_contracted_without_a_jump() -> None:
    x = np.linspace(-30.0, 30.0, 2001)[:, None].repeat(3, axis=1)
    y = contract(x, np.zeros(3), np.ones(3))
    assert (np.diff(y, axis=0) > 0.0).all()
    assert np.abs(y).max() < 2.0
    assert np.allclose(y[np.abs(x) <= 1.0], x[np.abs(x) <= 1.0])


def test_the_range_is_to_the_nearest_camera() -> None:
    centres = np.array([[0.0, 0.0, 1.0], [0.0, 3.0, 4.0]])
    cameras = np.array([[0.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
    values, palette = range_level(centres, cameras, "m", metres=2.0)
    ranges = values / 255.0 * palette.largest / 2.0
    assert np.allclose(ranges, [1.0, 4.0], atol=0.02)


def test_a_medium_without_water_is_none_and_a_damaged_one_is_refused() -> None:
    assert water_of({"active": False}) is None
    with pytest.raises(ValueError, match="no set of numbers"):
        water_of({"active": True, "backscatter": {}})
