"""The paper's network behind the hybrid prior: aspect ratio kept, and all that it says is used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from aquaflow.config.tracking import PriorConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.lab.networks.mast3r.export import export
from aquaflow.lab.networks.mast3r.network import TINY, Mast3r
from aquaflow.prior import flow as dense
from aquaflow.prior.factory import make_prior
from aquaflow.prior.flow import pixel_grid
from aquaflow.prior.hybrid import HybridPair, HybridPrior
from aquaflow.prior.mast3r_describer import CELL_PX, Mast3rDescriber
from aquaflow.prior.runtime import RuntimeSettings
from tests.prior.textured_pictures import HEIGHT, WIDTH, moved_pair, shift

pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("onnxscript")]

FRAME = (64, 64)
TALL = CameraModel(WIDTH, HEIGHT, 200.0, 200.0, 120.0, 90.0)
CELLS = (6, 8)
"""Rows and columns of cells that show a picture of 4 : 3 in FRAME."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mast3r") / "prior"
    torch.manual_seed(0)
    export(Mast3r(TINY), path, FRAME[1], FRAME[0], "none", lambda *_: None)
    return path


@pytest.fixture
def describer(folder: Path) -> Mast3rDescriber:
    return Mast3rDescriber(folder, RuntimeSettings(device="cpu"))


def pictures() -> tuple[np.ndarray, np.ndarray]:
    return moved_pair(shift(0.4 * WIDTH, -20.0))


def compared(describer: Mast3rDescriber):  # type: ignore[no-untyped-def]
    a, b = (describer.features(describer.fit(picture)) for picture in pictures())
    return describer.compare(a, b, TALL, TALL)


def test_cells_ranges_and_confidence_are_those_of_the_picture_alone(
    describer: Mast3rDescriber,
) -> None:
    pair = compared(describer)
    a, b = pair.cells
    assert a.shape == b.shape == (*CELLS, TINY.descriptor)
    assert pair.range_a.log_range.shape == pair.range_b.log_range.shape == CELLS
    assert pair.confidence.shape == CELLS


def test_cells_lie_where_the_picture_is_in_the_frame(describer: Mast3rDescriber) -> None:
    pair = compared(describer)
    tokens = [describer.features(describer.fit(picture)) for picture in pictures()]
    D = describer.decode(*tokens[::-1])["D_b"][0]
    band = (FRAME[0] - CELLS[0] * CELL_PX) // 2 // CELL_PX * CELL_PX
    np.testing.assert_array_equal(pair.cells[0][0, 0], D[band + CELL_PX // 2, CELL_PX // 2])


def test_points_and_descriptors_are_those_of_all_pixels_of_the_picture(
    describer: Mast3rDescriber,
) -> None:
    pair = compared(describer)
    size = (CELLS[0] * CELL_PX, CELLS[1] * CELL_PX)
    for found in (pair.dense(), pair.dense(back=True)):
        assert found.points_a.shape == found.points_b.shape == (*size, 3)
        for descriptors in (found.descriptors_a, found.descriptors_b):
            assert descriptors.shape == (*size, TINY.descriptor)
            np.testing.assert_allclose(np.linalg.norm(descriptors, axis=-1), 1.0, rtol=1e-5)


def test_each_way_is_decoded_once(
    describer: Mast3rDescriber, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    decoded = describer.decode
    monkeypatch.setattr(describer, "decode", lambda *ab: asked.append(1) or decoded(*ab))
    pair = compared(describer)
    for _ in range(2):
        _ = (
            pair.cells,
            pair.dense(),
            pair.dense(back=True),
            pair.range_a,
            pair.range_b,
            pair.confidence,
        )
    assert len(asked) == 2


def test_half_of_the_cells_keep_their_weight_and_none_gains(describer: Mast3rDescriber) -> None:
    confidence = compared(describer).confidence
    assert ((confidence >= 0.0) & (confidence <= 1.0)).all()
    assert 0.5 <= (confidence == 1.0).mean() < 1.0


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_confidence_that_is_no_number_takes_no_weight(
    bad: float, describer: Mast3rDescriber, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {"C_b": np.full((1, *FRAME), 2.0, np.float32)}
    found["C_b"][0, 20:30] = bad
    found["C_b"][0, :, 44:] = 0.5
    monkeypatch.setattr(describer, "decode", lambda a, b: found)
    confidence = compared(describer).confidence
    assert set(np.unique(confidence)) == {0.25, 1.0}
    found["C_b"][:] = bad
    assert (compared(describer).confidence == 1.0).all()


def test_matches_that_the_network_found_weigh_what_it_says_of_them(folder: Path) -> None:
    prior = make_prior(PriorConfig(kind="folder", folder=folder, device="cpu"))
    assert isinstance(prior, HybridPrior)
    a, b = (prior.encode(picture, TALL) for picture in pictures())
    pair = prior.decode(a, b)
    flow = dense.confidence(pair.flow)
    assert isinstance(pair, HybridPair)
    assert (flow >= pair.C).all()
    assert (0.999 * flow > pair.C).any()


def test_matches_that_were_predicted_are_not_weighed_and_the_network_is_not_asked(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prior = make_prior(PriorConfig(kind="folder", folder=folder, device="cpu"))
    assert isinstance(prior, HybridPrior)
    monkeypatch.setattr(Mast3rDescriber, "features", None)
    a, b = (prior.encode(picture, TALL) for picture in pictures())
    predicted = pixel_grid(HEIGHT, WIDTH) + np.float32([0.4 * WIDTH, -20.0])
    pair = prior.decode(a, b, predicted)
    np.testing.assert_array_equal(pair.C, dense.confidence(pair.flow))
