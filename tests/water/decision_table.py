"""``python -m tests.water.decision_table --dives 10``: is water found, and how well?"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tests.water.simulated_dives import Kind, dive
from tests.water.water_observations import fitted

SPANS, NOISES, EXPOSURES = (1.1, 1.3, 1.5, 2.0, 3.0), (0.005, 0.02), (0.0, 0.2)


@dataclass(frozen=True)
class Row:
    """All dives of one kind."""

    kind: Kind
    right: int
    """Dives whose water was found, or which were found clear."""
    dives: int
    error: float
    """Median relative error of beta_a; NaN in clear water."""
    normalised: float
    """Root mean square error of log beta_a over its stated deviation; NaN in clear water."""


def row(kind: Kind, dives: int) -> Row:
    """Fit ``dives`` drawn dives of one kind."""
    right, errors, stated = 0, [], []
    for seed in range(dives):
        drawn = dive(kind, seed)
        estimate = fitted(drawn.seen)
        right += estimate.model.water is kind.water
        if kind.water and estimate.beta_a_sigma is not None:
            errors.append(np.log(estimate.beta_a / drawn.beta_a))
            stated.append(estimate.beta_a_sigma)
    if not errors:
        return Row(kind, right, dives, np.nan, np.nan)
    error, sigma = np.array(errors), np.array(stated)
    normalised = float(np.sqrt(np.mean((error / sigma) ** 2)))
    return Row(kind, right, dives, float(np.median(np.abs(np.expm1(error)))), normalised)


def kinds() -> Iterator[Kind]:
    """All rows of the table."""
    for water, span, noise, exposure in itertools.product((True, False), SPANS, NOISES, EXPOSURES):
        yield Kind(span, noise, exposure, water)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dives", type=int, default=10, help="of each of the 40 kinds")
    dives = parser.parse_args().dives
    print("| water | span | noise | exposure | decided rightly | beta_a error | over its sigma |")
    print("|---|---|---|---|---|---|---|")
    for kind in kinds():
        found = row(kind, dives)
        water = "water" if kind.water else "clear"
        print(
            f"| {water} | 1:{kind.span} | {kind.noise} | {kind.exposure} "
            f"| {found.right} of {found.dives} | {found.error:.0%} | {found.normalised:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
