"""What an exported compact prior finds of held-out pairs, as its card says, in 32 and in 8 bits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from aquaflow.lab.training.compact_range import (
    calibration_figures,
    normalised_errors,
    variance_factor,
)
from aquaflow.lab.training.compact_recall import (
    mean_recall,
    onnx_comparison,
    onnx_encoder,
    tracked_recall,
)
from aquaflow.lab.training.pairs import Pair
from aquaflow.prior.compact.quantise import INT8_ENCODER
from aquaflow.prior.folder import DECODER, ENCODER, PriorCard, write_card

ENCODERS = {"32_bit": ENCODER, "8_bit": INT8_ENCODER}
"""Files by the name that figures have in the card."""
LEAST_FACTOR = 1.0
"""Of the range's variance: on pairs of the training's kind errors are smaller than said (0.86), on
harder ones larger, and a variance that is too small harms more than one that is too large."""


def with_honest_range(folder: Path, card: PriorCard, pairs: list[Pair]) -> PriorCard:
    """The card of ``folder`` with the factor that makes the range's variance no less than that of
    ``pairs``.

    Fitted in 8 bits, which is what runs on a CPU; ``with_figures`` shows how well it holds in 32.
    """
    encode, compare = onnx_encoder(folder / INT8_ENCODER), onnx_comparison(folder / DECODER)
    factor = max(LEAST_FACTOR, variance_factor(normalised_errors(encode, compare, pairs)))
    card = card.model_copy(update={"range_variance_factor": round(factor, 4)})
    write_card(folder, card)
    return card


def with_figures(folder: Path, card: PriorCard, sets: dict[str, list[Pair]]) -> PriorCard:
    """The card of ``folder``, extended by its figures on several sets of pairs."""
    figures = {name: figures_of(folder, card, pairs) for name, pairs in sets.items()}
    card = card.model_copy(update={"training": (card.training or {}) | {"figures": figures}})
    write_card(folder, card)
    return card


def figures_of(
    folder: Path, card: PriorCard, pairs: list[Pair], ranged: bool = True
) -> dict[str, Any]:
    """Recall in 32 and 8 bits and, where the pairs are ``ranged``, how honest the variance is."""
    compare = onnx_comparison(folder / DECODER)
    figures: dict[str, Any] = {
        "pairs": sum(len(pair.a.K) for pair in pairs),
        "flow_alone_2px": round(tracked_recall(None, pairs)["flow_2px"], 4),
    }
    for bits, file in ENCODERS.items():
        encode = onnx_encoder(folder / file)
        found = mean_recall(encode, compare, pairs) | tracked_recall(encode, pairs)
        if ranged:
            errors = normalised_errors(encode, compare, pairs)
            found |= calibration_figures(errors / card.range_variance_factor**0.5)
        else:
            del found["log_range"]
        figures[bits] = {name: round(value, 4) for name, value in found.items()}
    return figures
