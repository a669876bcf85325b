"""The compact prior as ONNX: equal to torch, small, of any size, and still good in 8 bits."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch
from typer.testing import CliRunner

from aquaflow import cli
from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.cli import prior
from aquaflow.lab.networks.compact.export import (
    INPUTS,
    LICENCE,
    LICENCE_WITH_PICTURES,
    OUTPUTS,
    export,
    fold,
    load_checkpoint,
    parity_of,
)
from aquaflow.lab.networks.compact.network import COARSE, CompactPrior, NetworkSize
from aquaflow.prior.folder import DECODER, ENCODER, read_card
from aquaflow.prior.runtime import INT8_ENCODER, NetworkSession, RuntimeSettings
from tests.prior.textured_pictures import HEIGHT, WIDTH, moved_pair, shift

pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")

pytestmark = pytest.mark.usefixtures("one_thread")

SHIPPED = Path(cli.__file__).parents[1] / "prior" / "weights" / "compact"
SMALL = NetworkSize(levels=(4, 6, 8, 10), merged=(10, 8, 6), fine=6, coarse=8, head=4)
CPU = RuntimeSettings(device="cpu")
MOST_BYTES = 16 << 20

Picture = npt.NDArray[np.float32]


def silent(stage: str, done: int, total: int) -> None:
    """No progress bar."""


def small() -> CompactPrior:
    """With running means and variances that are not the initial ones."""
    torch.manual_seed(0)
    network = CompactPrior(SMALL).train()
    with torch.no_grad():
        network.encode(torch.rand(4, 3, 64, 64))
        network.comparison(*torch.rand(2, 2, 8, 6, 8), *torch.rand(2, 2, 2, 6, 8))
    return network.eval()


def prepared(image: npt.NDArray[np.uint8]) -> Picture:
    """[1, 3, h, w], cut to multiples of 16."""
    height, width = (side // 16 * 16 for side in image.shape[:2])
    return np.float32(image[:height, :width].transpose(2, 0, 1)[None] / 255.0)


def test_folding_the_normalisation_changes_nothing() -> None:
    network, picture = small(), torch.rand(1, 3, 48, 64)
    frozen = fold(network)
    with torch.no_grad():
        for one, other in zip(network.encode(picture), frozen.encode(picture), strict=True):
            assert torch.allclose(one, other, atol=1e-5)
    assert not any(isinstance(m, torch.nn.BatchNorm2d) for m in frozen.modules())


@pytest.mark.slow
def test_a_fresh_export_is_torchs_to_1e_4_at_every_size_and_close_in_8_bits(
    tmp_path: Path,
) -> None:
    pytest.importorskip("onnxscript", reason="pip install 'aquaflow[export]'")
    network = small()
    pictures = [prepared(moved_pair(shift(0, 0), seed)[0]) for seed in range(4)]
    card = export(network, tmp_path, {"steps": 0}, pictures, silent)
    assert max(card.parity.values()) <= 1e-4
    assert read_card(tmp_path) == card
    for width, height in ((96, 208), (176, 48)):
        assert max(parity_of(network, tmp_path, width, height).values()) <= 1e-4
    exact, rounded = (NetworkSession(tmp_path / name, CPU) for name in (ENCODER, INT8_ENCODER))
    for name in ("D", "Dc"):
        one, other = (session({"image": pictures[0]})[name] for session in (exact, rounded))
        assert float((one * other).sum(1).mean()) > 0.98
    assert card.licence == LICENCE
    training = {"steps": 1, "pictures": ["reef"]}
    export(network, tmp_path, training, pictures[:1], silent)  # replaces the one that is there
    assert read_card(tmp_path).training == training
    assert read_card(tmp_path).licence == LICENCE_WITH_PICTURES


def test_a_folder_of_something_else_is_not_written_to(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="is not empty"):
        export(small(), tmp_path, {}, [], silent)


def test_what_ships_is_whole_small_and_was_torchs_when_it_was_exported() -> None:
    card = read_card(SHIPPED)
    assert set(card.files) == {ENCODER, DECODER, INT8_ENCODER}
    assert sum((SHIPPED / name).stat().st_size for name in card.files) <= MOST_BYTES
    assert max(card.parity.values()) <= 1e-4
    assert card.training is not None
    assert {"seed", "steps", "scenes", "hardware", "held_out"} <= set(card.training)


def test_verify_reports_what_ships() -> None:
    result = CliRunner().invoke(cli.app, ["lab", "prior", "verify", str(SHIPPED), "--json"])
    names = {row["name"] for row in json.loads(result.stdout)["outputs"]}
    assert names == {"D", "Dc", "C", *OUTPUTS}


def test_verify_finds_out_that_what_ships_is_not_of_other_weights(tmp_path: Path) -> None:
    torch.manual_seed(1)
    torch.save({"network": CompactPrior().state_dict()}, tmp_path / "checkpoint.pt")
    with pytest.raises(AquaFlowError, match="differs from torch"):
        prior.verify(SHIPPED, tmp_path / "checkpoint.pt")


def test_what_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    (tmp_path / "checkpoint.pt").write_bytes(b"no checkpoint")
    for name in ("checkpoint.pt", "absent.pt"):
        with pytest.raises(InputError, match="no checkpoint"):
            load_checkpoint(tmp_path / name)


@pytest.mark.parametrize("name", [ENCODER, INT8_ENCODER])
def test_what_ships_finds_a_picture_that_moved_by_two_cells(name: str) -> None:
    a, b = (prepared(picture) for picture in moved_pair(shift(2.0 * COARSE, -COARSE)))
    encoder = NetworkSession(SHIPPED / name, CPU)
    Dc_a, Dc_b = (encoder({"image": picture})["Dc"] for picture in (a, b))
    rows, columns = Dc_a.shape[2:]
    assert (rows, columns) == (HEIGHT // 16 * 2, WIDTH // 16 * 2)
    rays = np.zeros((1, 2, rows, columns), np.float32)
    pair = dict(zip(INPUTS, (Dc_a, Dc_b, rays, rays), strict=True))
    pixels = NetworkSession(SHIPPED / DECODER, CPU)(pair)["pixels_ab"][0]
    v, u = (np.mgrid[:rows, :columns] + 0.5) * COARSE
    error = np.hypot(pixels[0] - u - 2.0 * COARSE, pixels[1] - v + COARSE)
    assert np.mean(error[1:, :-2] < 4.0) > 0.9
