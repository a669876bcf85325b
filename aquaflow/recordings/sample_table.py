"""The file of a dive's samples, ``telemetry.csv``.

It has the columns t_s, arrival_s, kind, source, v0, v1, v2, v3, in order of arrival:

- ``depth``: v0 metres below the surface;
- ``attitude``: v0..v3 quaternion wxyz of the body (forward, right, down) in NED;
- ``angular_rate``: v0..v2 rad/s, body frame;
- ``acceleration``: v0..v2 specific force, m/s^2, body frame;
- ``velocity``: v0..v2 m/s over ground, body frame, v3 figure of merit (1 sigma, m/s);
- ``altitude``: v0 metres to the first return along the body's down axis;
- ``position``: v0 latitude and v1 longitude in degrees (WGS 84), v2 1 sigma in metres;
- ``utc_time``: v0 nanoseconds since 1970-01-01 UTC, an integer.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.storage.table import csv_text
from aquaflow.types import KIND_OF, KINDS, LENGTHS, VALUES, TelemetrySample, values_of

__all__ = ["HEADER", "read_telemetry", "sample_of", "write_telemetry"]

HEADER = ("t_s", "arrival_s", "kind", "source", "v0", "v1", "v2", "v3")
"""Columns of telemetry.csv; the values of each kind are in v0 to v3."""

DIGITS = 9
"""Significant ones of a value: finer than any instrument."""


WRITTEN = frozenset(KINDS) - {"lights"}
"""Kinds that a line may be of: a synthetic vehicle has no lamps."""
EXACT = frozenset({"position", "utc_time"})
"""Kinds that are written with every digit: the ninth of a longitude is 0.1 m."""


def write_telemetry(path: Path, samples: Iterable[TelemetrySample]) -> None:
    """Write samples in the order given; their times must count from the first picture."""
    rows: list[Sequence[str]] = [HEADER]
    for sample in samples:
        stamps = (f"{ns * 1e-9:.9f}" for ns in (sample.t_ns, sample.arrival_ns))
        rows.append([*stamps, *_cells(sample)])
    with path.open("w", newline="") as file:
        file.write(csv_text(rows))


def read_telemetry(path: Path) -> Iterator[TelemetrySample]:
    """Samples of a ``telemetry.csv`` in the order of the file, which is that of arrival.

    Raises:
        InputError: the file is missing, or a line of it is not as the module's text says.
    """
    try:
        with path.open(newline="") as file:
            for line in csv.DictReader(file):
                t_ns, arrival_ns = (round(float(line[key]) * 1e9) for key in HEADER[:2])
                cells = [line[key] for key in HEADER[4:]]
                read: Callable[[str], float] = int if line["kind"] == "utc_time" else float
                values = [read(cell) for cell in cells if cell]
                yield sample_of(line["kind"], t_ns, arrival_ns, line["source"], values)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the telemetry {path}: {reason_of(error)}") from error
    except (KeyError, TypeError, ValueError, OverflowError, csv.Error) as error:
        raise InputError(
            f"{path} holds a line that is no telemetry sample; its columns must be "
            f"{', '.join(HEADER)}"
        ) from error


def sample_of(
    kind: str, t_ns: int, arrival_ns: int, source: str, values: Sequence[float]
) -> TelemetrySample:
    """The sample of one kind with the values of its columns.

    Raises:
        ValueError: the kind is unknown, or has another number of values.
    """
    names = VALUES[KINDS[kind]] if kind in WRITTEN else ()
    counts = {name: LENGTHS.get(name, 1) for name in names}
    if not names or len(values) != sum(counts.values()):
        raise ValueError(f"no sample of kind '{kind}' has {len(values)} values")
    left = iter(values)
    fields: dict[str, Any] = {
        name: next(left) if count == 1 else tuple(islice(left, count))
        for name, count in counts.items()
    }
    return KINDS[kind](t_ns, arrival_ns, source, **fields)


def _cells(sample: TelemetrySample) -> list[str]:
    """Kind, source and values of one sample."""
    kind = KIND_OF[type(sample)]
    if kind not in WRITTEN:
        raise ValueError(f"telemetry.csv has no kind for {type(sample).__name__}")
    cells = [repr(v) if kind in EXACT else f"{v:.{DIGITS}g}" for v in values_of(sample)]
    return [kind, sample.source, *cells, *[""] * (4 - len(cells))]
