"""Describers: pictures are fitted to the network, and each cell gets a unit descriptor."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.geometry.camera import CameraModel
from aquaflow.prior import describers
from aquaflow.prior.describers import CompactDescriber, describer_in
from aquaflow.prior.folder import read_card, write_card
from aquaflow.prior.runtime import Precision, RuntimeSettings
from tests.prior.stub_prior import write_stub

pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")
pytest.importorskip("onnx", reason="pip install 'aquaflow[export]'")

CPU = RuntimeSettings(device="cpu")


@pytest.fixture(scope="module")
def describer(tmp_path_factory: pytest.TempPathFactory) -> CompactDescriber:
    return CompactDescriber(write_stub(tmp_path_factory.mktemp("stub") / "free"), CPU)


def picture(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.uint8)


@pytest.mark.parametrize(
    ("shape", "fitted"),
    [
        ((240, 320), (240, 320)),
        ((120, 160), (128, 160)),  # 7.5 tiles; never enlarged
        ((1080, 1920), (208, 368)),
        ((480, 100), (480, 96)),
        ((8, 2000), (16, 2000)),
    ],
)
def test_a_picture_becomes_one_of_whole_tiles_and_no_more_pixels_than_exported_for(
    describer: CompactDescriber, shape: tuple[int, int], fitted: tuple[int, int]
) -> None:
    assert describer.fit(picture(*shape)).shape == (*fitted, 3)


def test_a_size_that_was_exported_fixed_is_kept_to(tmp_path: Path) -> None:
    describer = CompactDescriber(write_stub(tmp_path / "fixed", 48, 64), CPU)
    assert describer.fit(picture(240, 320)).shape == (48, 64, 3)


def test_every_cell_has_a_descriptor_of_length_one(describer: CompactDescriber) -> None:
    features = describer.features(picture(48, 64))
    assert features.shape == (6, 8, 64)
    camera = CameraModel(64, 48, 64.0, 64.0, 32.0, 24.0)
    cells, _ = describer.compare(features, features, camera, camera).cells
    np.testing.assert_allclose(np.linalg.norm(cells, axis=-1), 1.0, atol=2e-3)


def test_a_black_picture_has_descriptors_that_are_numbers(describer: CompactDescriber) -> None:
    assert np.isfinite(describer.features(np.zeros((48, 64, 3), np.uint8))).all()


@pytest.mark.parametrize(("precision", "sign"), [("auto", -1.0), ("int8", -1.0), ("fp32", 1.0)])
def test_on_a_processor_eight_bits_run_unless_others_are_asked_for(
    precision: Precision, sign: float, tmp_path: Path
) -> None:
    folder = write_stub(tmp_path / "stub", int8=True)
    plain = CompactDescriber(write_stub(tmp_path / "plain"), CPU).features(picture(16, 16))
    settings = RuntimeSettings(device="cpu", precision=precision)
    features = CompactDescriber(folder, settings).features(picture(16, 16))
    np.testing.assert_array_equal(features, sign * plain)


def test_eight_bits_that_were_not_exported_are_an_error_if_asked_for(tmp_path: Path) -> None:
    folder = write_stub(tmp_path / "stub")
    with pytest.raises(InputError, match="use precision: fp32"):
        CompactDescriber(folder, RuntimeSettings(device="cpu", precision="int8"))


def test_on_a_gpu_eight_bits_are_not_the_choice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_stub(tmp_path / "stub", int8=True)
    opened: list[str] = []

    class OnGpu:
        device, inputs = "cuda", {"image": (1, 3, "height", "width")}

        def __init__(self, path: Path, settings: RuntimeSettings) -> None:
            opened.append(path.name)

    monkeypatch.setattr(describers, "NetworkSession", OnGpu)
    CompactDescriber(folder, RuntimeSettings(device="cuda"))
    assert opened[-1] == "encoder.onnx"


def test_the_card_says_which_network_it_is(tmp_path: Path) -> None:
    assert describer_in(write_stub(tmp_path / "stub"), CPU).name == "compact"


def test_the_range_s_variance_is_what_the_card_makes_of_it(tmp_path: Path) -> None:
    shipped = Path(describers.__file__).parent / "weights" / "compact"
    folder = Path(shutil.copytree(shipped, tmp_path / "copy"))
    card = read_card(folder)
    variances = []
    for factor in (1.0, 4.0):
        write_card(folder, card.model_copy(update={"range_variance_factor": factor}))
        describer = CompactDescriber(folder, CPU)
        features = describer.features(picture(48, 64))
        camera = CameraModel(64, 48, 60.0, 60.0, 32.0, 24.0)
        pair = describer.compare(features, features, camera, camera)
        variances.append((pair.range_a.variance, pair.range_b.variance))
    np.testing.assert_allclose(variances[1], 4.0 * np.array(variances[0]), rtol=1e-5)
