"""A length that a person marked in a finished dive: kept, and the dive brought to metres by it."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.base.storage.dive_status import refuse_unfinished
from aquaflow.dive.dive import Dive
from aquaflow.survey.measure.reef_files import CSV, JSON, write_reef_numbers
from aquaflow.survey.measure.rescaling import rescale, why_not
from aquaflow.telemetry.known_lengths.known_length import (
    KnownLength,
    LengthScale,
    read_known_lengths,
    scale_of,
    with_length,
    write_known_lengths,
)

Progress = Callable[[str, int, int], None]
"""Called with what is done, how much of it, and how much there is."""


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


def keep_length(dive: Path, known: KnownLength, progress: Progress | None = None) -> Marked:
    """Write ``known`` into the dive, and rescale its files where nothing speaks against it.

    The ground is measured anew then: on cells of so many centimetres, as other dives are.

    Raises:
        InputError: the dive is not finished, or a file of it cannot be read or written.
    """
    refuse_unfinished(dive)
    lengths = with_length(read_known_lengths(dive), known)
    write_known_lengths(dive, lengths)
    members = [each for each in lengths if each.sub_map == known.sub_map]
    together = scale_of(members)
    assert together is not None  # of one length at least
    read = Dive(dive)
    unchanged = why_not(read.metric_frames.get(known.sub_map), together)
    if unchanged is None:
        rescale(read, known.sub_map, members, together)
        if known.sub_map == read.main:
            _measure_anew(dive, progress)
    return Marked(known, together, unchanged)


def _measure_anew(dive: Path, progress: Progress | None) -> None:
    """The dive's reef numbers in its new unit; none where it had none, or cannot be measured."""
    if not (dive / JSON).is_file():
        return
    from aquaflow.survey.measure.finished_dive import numbers_of_dive

    # Those in another unit would contradict the rest of the folder.
    for name in (JSON, CSV):
        (dive / name).unlink(missing_ok=True)
    try:
        with tempfile.TemporaryDirectory() as work:
            write_reef_numbers(dive, numbers_of_dive(Dive(dive), Path(work), progress=progress))
    except InputError:
        return  # aquaflow measure says why


def _plus_minus(metres: float, relative_sigma: float) -> str:
    return f"{metres:.4g} m +- {metres * relative_sigma:.2g} m (1 sigma)"
