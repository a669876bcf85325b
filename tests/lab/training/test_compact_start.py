"""A training that starts from exported weights: the same function, also in a larger network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from aquaflow.base.errors import InputError
from aquaflow.lab.networks.compact.export import load_checkpoint, parity_of
from aquaflow.lab.networks.compact.network import CompactPrior, NetworkSize, normalised
from aquaflow.lab.training.compact_start import exported_network, grow, started
from aquaflow.lab.training.pair_generator.cameras import TRAINING
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.render import render_pairs
from aquaflow.lab.training.pair_generator.scene import Detail
from aquaflow.lab.training.pairs import Pair
from aquaflow.prior.factory import SHIPPED
from aquaflow.prior.folder import CARD, PriorCard, write_card

pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")
pytest.importorskip("onnx", reason="pip install 'aquaflow[export]'")

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL = NetworkSize(levels=(4, 6, 8, 10), merged=(10, 8, 6), fine=6, coarse=8, head=4)


@pytest.fixture(scope="module")
def pair() -> Pair:
    return render_pairs(Draw(2), 2, 96, 64, TRAINING, Detail(terrain=64, texture=128))


def test_exported_weights_are_read_whole() -> None:
    network = exported_network(SHIPPED)
    assert network.size == NetworkSize()
    assert max(parity_of(network, SHIPPED).values()) <= 1e-4


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_a_started_network_computes_what_the_exported_one_does(factor: float, pair: Pair) -> None:
    network = started(SHIPPED, NetworkSize().times(factor), pair)
    assert network.size == NetworkSize().times(factor)
    assert max(parity_of(network, SHIPPED).values()) <= 1e-4


def test_a_started_network_computes_it_with_the_statistics_of_a_batch_too(pair: Pair) -> None:
    images = torch.cat([pair.a.image, pair.b.image])
    network = started(SHIPPED, NetworkSize(), pair)
    with torch.no_grad():
        expected = network.eval().encode(images)
        found = network.train().encode(images)
    for one, other in zip(expected[:2], found[:2], strict=True):
        assert float((one * other).sum(1).mean()) > 0.99
    for _, _, _, norm in normalised(network):
        assert norm.running_var is not None
        assert float(norm.running_var.min()) >= 0.0


def test_new_channels_learn_and_act_after_some_steps(pair: Pair) -> None:
    torch.manual_seed(0)
    small = CompactPrior(SMALL).train()
    network = grow(small, replace(SMALL, levels=(6, 8, 12, 14), merged=(12, 10, 8), head=6))
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-2)
    fine = network.encoder.fine.weight
    assert not bool(fine[:, SMALL.merged[2] :].any())
    for _ in range(2):
        optimiser.zero_grad()
        network.encode(pair.a.image).D[:, 0].sum().backward()
        optimiser.step()
    assert bool(fine[:, SMALL.merged[2] :].any())


def test_a_network_does_not_shrink() -> None:
    with pytest.raises(InputError, match="cannot shrink"):
        grow(CompactPrior(SMALL), replace(SMALL, head=2))


def test_what_is_no_compact_prior_is_refused(tmp_path: Path, pair: Pair) -> None:
    card = PriorCard.model_validate_json((SHIPPED / CARD).read_bytes())
    write_card(tmp_path, card.model_copy(update={"name": "oracle", "files": {}}))
    with pytest.raises(InputError, match="no compact prior"):
        started(tmp_path, NetworkSize(), pair)


def test_a_checkpoint_says_its_size(tmp_path: Path) -> None:
    torch.save({"network": CompactPrior(SMALL).state_dict()}, tmp_path / "checkpoint.pt")
    assert load_checkpoint(tmp_path / "checkpoint.pt").size == SMALL
