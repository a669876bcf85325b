"""Depth networks that users bring: what they say arrives where the picture shows it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.config.tracking import PriorConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.prior.depth_describer import DepthDescriber
from aquaflow.prior.describe import describe
from aquaflow.prior.factory import make_prior
from aquaflow.prior.flow_pair import FlowPair
from aquaflow.prior.folder import CARD
from aquaflow.prior.hybrid import HybridPair
from aquaflow.prior.runtime import NetworkSession, RuntimeSettings
from aquaflow.tracking.learned import learned_depth
from tests.prior.textured_pictures import HEIGHT, WIDTH, moved_pair, shift
from tests.prior.tiny_depth import LOWEST, card, painted, write_network
from tests.tracking.learned.learned_scenes import KNOWN_SIGMA, TRUTH, measured
from tests.tracking.tracking_scenes import CAMERA

pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")
pytest.importorskip("onnx", reason="pip install 'aquaflow[export]'")

WIDE = CameraModel(96, 48, 60.0, 60.0, 48.0, 24.0)
HILLS = 0.3 + 0.4 * np.linspace(0.0, 1.0, 96)[None, :] * np.linspace(0.2, 1.0, 48)[:, None]
"""Depths of what WIDE sees."""


def folder(path: Path, network: dict[str, Any] | None = None, **stated: object) -> Path:
    """A described network, for pictures of as many pixels as WIDE's."""
    path.mkdir(parents=True, exist_ok=True)
    file = write_network(path / "net.onnx", **(network or {}))
    describe(file, path / "prior", card(**stated), 96, 48, "ours")
    return path / "prior"


def said(
    path: Path, picture: np.ndarray, camera: CameraModel
) -> tuple[np.ndarray, np.ndarray, HybridPair]:
    """z [H, W], Q [H, W], and the pair of the picture with itself."""
    prior = make_prior(PriorConfig(kind="folder", folder=path, device="cpu"))
    a = prior.encode(picture, camera)
    pair = prior.decode(a, a)
    assert isinstance(pair, HybridPair)
    assert pair.X_a is not None
    assert pair.Q_a is not None
    return pair.X_a[..., 2], pair.Q_a, pair


def test_depth_along_the_optical_axis_is_that_of_the_network(tmp_path: Path) -> None:
    z, Q, pair = said(folder(tmp_path), painted(HILLS), WIDE)
    np.testing.assert_allclose(z, HILLS, rtol=0.02)
    np.testing.assert_allclose(Q, 100.0, rtol=0.01)
    assert pair.range_unit == "shared"
    assert make_prior(PriorConfig(kind="folder", folder=tmp_path / "prior")).metric


@pytest.mark.parametrize("measure", ["inverse_depth", "log_depth"])
def test_other_measures_become_depth(measure: str, tmp_path: Path) -> None:
    path = folder(tmp_path, measure=measure, unit="unknown")
    z, _, pair = said(path, painted(HILLS), WIDE)
    expected = 1.0 / HILLS if measure == "inverse_depth" else np.exp(HILLS)
    np.testing.assert_allclose(z, expected, rtol=0.02)
    assert pair.range_unit == "own"


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (40.0, -3.0), (0.01, 7.0)])
def test_inverse_depth_up_to_scale_and_shift_becomes_the_keyframes(
    gain: float, offset: float, tmp_path: Path
) -> None:
    network = {"gain": gain, "offset": offset}
    path = folder(tmp_path, network, measure="inverse_depth", unit="affine")
    _, _, pair = said(path, painted(0.7 / TRUTH), CAMERA)
    assert pair.range_unit == "affine"
    assert pair.X_a is not None
    assert pair.Q_a is not None
    found = learned_depth(measured(), pair.X_a, pair.Q_a, KNOWN_SIGMA, pair.range_unit)
    assert found is not None
    right = np.s_[:, CAMERA.width // 2 :]
    assert np.median(np.abs(np.log(found.rho * TRUTH)[right])) < 0.02


@pytest.mark.parametrize("size", [(64, 64), (48, 160), (128, 64)])
@pytest.mark.parametrize("stride", [1, 8])
def test_a_network_of_one_size_sees_pictures_with_their_aspect_ratio(
    size: tuple[int, int], stride: int, tmp_path: Path
) -> None:
    path = folder(tmp_path, {"size": size, "stride": stride})
    describer = DepthDescriber(path, RuntimeSettings(device="cpu"))
    framed = describer.fit(painted(HILLS))
    assert framed.shape == (*size, 3)
    rows, columns = np.nonzero(framed[..., 2] == 0)  # around it, blue is not 0
    assert (np.ptp(columns) + 1) / (np.ptp(rows) + 1) == pytest.approx(2.0, rel=0.15)
    z, _, _ = said(path, painted(HILLS), WIDE)
    assert np.isfinite(z).all()
    inner = np.s_[8:-8, 8:-8]
    np.testing.assert_allclose(z[inner], HILLS[inner], rtol=0.12 if stride > 1 else 0.04)


@pytest.mark.parametrize(
    ("shape", "fitted"),
    [((48, 96), (48, 96)), ((480, 960), (48, 96)), ((24, 48), (48, 96)), ((300, 300), (64, 64))],
)
def test_a_network_of_any_size_gets_as_many_pixels_as_its_card_says(
    shape: tuple[int, int], fitted: tuple[int, int], tmp_path: Path
) -> None:
    describer = DepthDescriber(folder(tmp_path), RuntimeSettings(device="cpu"))
    assert describer.fit(np.zeros((*shape, 3), np.uint8)).shape == (*fitted, 3)


def test_an_input_with_a_number_of_views_gets_one(tmp_path: Path) -> None:
    z, _, _ = said(folder(tmp_path, {"views": True}), painted(HILLS), WIDE)
    np.testing.assert_allclose(z, HILLS, rtol=0.02)


def test_channels_and_normalisation_are_those_of_the_card(tmp_path: Path) -> None:
    path = folder(tmp_path, channels="bgr", mean=(0.406, 0.456, 0.485), std=(0.225, 0.224, 0.229))
    blue = painted(HILLS)[..., ::-1]
    z, _, _ = said(path, np.ascontiguousarray(blue), WIDE)
    # The network undoes the usual normalisation, which differs from this card's.
    np.testing.assert_allclose(z, (HILLS - 0.406) / 0.225 * 0.229 + 0.485, rtol=0.05, atol=0.02)


def test_what_is_no_number_is_unknown_and_nothing_else_is(tmp_path: Path) -> None:
    path = folder(tmp_path, {"logarithm": True}, measure="log_depth", unit="unknown")
    red = HILLS.copy()
    red[:, 40:56] = 0.5 * LOWEST
    z, Q, _ = said(path, painted(red), WIDE)
    assert np.isnan(z[:, 42:54]).all()
    assert (Q[:, 42:54] == 0.0).all()
    assert np.isfinite(z[:, :38]).all()


@pytest.mark.parametrize(
    ("kind", "green", "sigma"),
    [("weight", 0.5, 0.2), ("sigma", 0.3, 0.3), ("log_variance", 0.8, np.exp(0.4))],
)
def test_confidence_is_read_as_the_card_says(
    kind: str, green: float, sigma: float, tmp_path: Path
) -> None:
    path = folder(tmp_path, confidence="sure", confidence_kind=kind)
    _, Q, _ = said(path, painted(HILLS, green), WIDE)
    np.testing.assert_allclose(Q, sigma**-2, rtol=0.03)


def test_pixels_without_confidence_are_as_good_as_unknown(tmp_path: Path) -> None:
    path = folder(tmp_path, confidence="sure")
    _, Q, _ = said(path, painted(HILLS, 0.0), WIDE)
    assert (Q < 1e-6).all()


def test_matches_are_the_classical_ones_and_the_network_is_not_asked_for_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prior = make_prior(PriorConfig(kind="folder", folder=folder(tmp_path), device="cpu"))
    camera = CameraModel(WIDTH, HEIGHT, 200.0, 200.0, 120.0, 90.0)
    pictures = moved_pair(shift(0.4 * WIDTH, -20.0))
    monkeypatch.setattr(NetworkSession, "outputs_of", None)
    found = prior.decode(*(prior.encode(picture, camera) for picture in pictures))
    classical = ClassicalPrior()
    expected = classical.decode(*(classical.encode(picture, camera) for picture in pictures))
    np.testing.assert_array_equal(found.matches, expected.matches)
    np.testing.assert_array_equal(found.C, expected.C)
    assert isinstance(found, FlowPair)


@pytest.mark.parametrize(
    ("stated", "sentence"),
    [
        ({"input": "picture"}, "takes image and not picture"),
        ({"output": "disparity"}, "no output disparity but depth, sure"),
        ({"confidence": "trust"}, "no output trust"),
    ],
)
def test_names_that_the_network_does_not_have_are_refused(
    stated: dict[str, str], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=sentence):
        folder(tmp_path, **stated)
    assert not (tmp_path / "prior").exists()


def test_an_output_that_is_no_plane_is_refused(tmp_path: Path) -> None:
    """A network of one pixel has no axis left."""
    with pytest.raises(InputError, match="not one number for each pixel"):
        folder(tmp_path, {"size": (8, 8), "stride": 8})


def test_an_output_that_is_the_same_everywhere_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="0 % of the test picture"):
        folder(tmp_path, {"gain": 0.0, "offset": 3.0}, measure="inverse_depth", unit="affine")


def test_a_card_without_the_part_on_depth_is_refused(tmp_path: Path) -> None:
    path = folder(tmp_path)
    stated = json.loads((path / CARD).read_text())
    (path / CARD).write_text(json.dumps(stated | {"depth": None}))
    with pytest.raises(InputError, match="says nothing of depth"):
        DepthDescriber(path, RuntimeSettings(device="cpu"))
