"""A prior's folder: what it promises is checked before it is used."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from aquaflow.base.errors import InputError
from aquaflow.prior.folder import CARD, PriorCard, read_card, sha256_of, write_card


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "encoder.onnx").write_bytes(b"weights" * 1000)
    files = {"encoder.onnx": sha256_of(tmp_path / "encoder.onnx")}
    card = PriorCard(
        name="compact",
        width=320,
        height=240,
        descriptor=24,
        metric=False,
        licence="Apache-2.0",
        opset=18,
        files=files,
        parity={"D_a": 1e-6},
        training={"seed": 3},
    )
    write_card(tmp_path, card)
    return tmp_path


def rewrite(folder: Path, **changes: object) -> None:
    card = json.loads((folder / CARD).read_text())
    (folder / CARD).write_text(json.dumps(card | changes))


def test_a_card_is_read_as_it_was_written(folder: Path) -> None:
    card = read_card(folder)
    assert (card.name, card.width, card.training) == ("compact", 320, {"seed": 3})


def test_a_changed_file_is_refused(folder: Path) -> None:
    (folder / "encoder.onnx").write_bytes(b"other" * 1000)
    with pytest.raises(InputError, match=r"encoder.onnx is not the file that was exported"):
        read_card(folder)


def test_a_missing_file_is_refused(folder: Path) -> None:
    (folder / "encoder.onnx").unlink()
    with pytest.raises(InputError, match=r"lacks encoder.onnx"):
        read_card(folder)


def test_a_folder_without_a_card_is_no_prior(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is no prior"):
        read_card(tmp_path)


def test_an_unknown_key_and_a_broken_card_are_named(folder: Path) -> None:
    rewrite(folder, colour="red")
    with pytest.raises(InputError, match="colour"):
        read_card(folder)
    (folder / CARD).write_text("{")
    with pytest.raises(InputError, match="export the prior again"):
        read_card(folder)


def test_a_card_does_not_reach_outside_its_folder(folder: Path) -> None:
    rewrite(folder, files={"../secret": "0"})
    with pytest.raises(InputError, match="outside its folder"):
        read_card(folder)
