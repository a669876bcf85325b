"""A length that a person marked in a finished dive: kept, and the dive brought to metres by it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from aquaflow.dive.rescaling import rescale, why_not
from aquaflow.fusion.known_lengths.known_length import KnownLength, LengthScale, scale_of
from aquaflow.fusion.known_lengths.known_lengths_file import (
    read_known_lengths,
    with_length,
    write_known_lengths,
)
from aquaflow.fusion.metric_file import read_metric_file


@dataclass(frozen=True)
class Marked:
    """What became of it."""

    known: KnownLength
    together: LengthScale
    """With all other known lengths of the sub-map."""
    unchanged: str | None
    """Why the dive's files keep their unit, in a sentence; None if they are in metres now."""

    def in_words(self) -> str:
        """Sentences about one map unit."""
        known, together = self.known, self.together
        said = f"1 map unit is {_plus_minus(known.metres_per_unit, known.relative_sigma)}."
        if together.used + len(together.rejected) > 1:
            against = f", {len(together.rejected)} contradicting" if together.rejected else ""
            all_of_them = _plus_minus(together.metres_per_unit, together.relative_sigma)
            said += f"\nWith all known lengths ({together.used} used{against}): {all_of_them}."
        return said


def keep_length(dive: Path, known: KnownLength) -> Marked:
    """Write ``known`` into the dive, and rescale its files where nothing speaks against it.

    Raises:
        InputError: a file of the dive cannot be read or written.
    """
    lengths = with_length(read_known_lengths(dive), known)
    write_known_lengths(dive, lengths)
    members = [each for each in lengths if each.sub_map == known.sub_map]
    together = scale_of(members)
    assert together is not None  # of one length at least
    unchanged = why_not(read_metric_file(dive).get(known.sub_map), together)
    if unchanged is None:
        rescale(dive, known.sub_map, members, together)
    return Marked(known, together, unchanged)


def _plus_minus(metres: float, relative_sigma: float) -> str:
    return f"{metres:.4g} m +- {metres * relative_sigma:.2g} m (1 sigma)"
