"""Telemetry samples as JSON, and telemetry.jsonl: those of a live dive, a line each as they arrive.

A line is the sample's JSON object with its ``kind``. A line that was cut off, or damaged, costs
itself.
"""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from aquaflow.base.errors.regular_file import open_regular
from aquaflow.base.storage.atomic import is_cut_short, open_to_append
from aquaflow.types import KIND_OF, KINDS, LENGTHS, STAMP, VALUES, TelemetrySample


def sample_schema(kind: str) -> bytes:
    """JSON schema of one kind of sample."""
    properties: dict[str, Any] = {
        "t_ns": {"type": "integer", "description": "CLOCK_MONOTONIC of the measurement"},
        "arrival_ns": {"type": "integer", "description": "CLOCK_MONOTONIC of its arrival"},
        "source": {"type": "string"},
    }
    for field in fields(KINDS[kind]):
        number: dict[str, Any] = {"type": "integer" if field.name == "utc_ns" else "number"}
        length = LENGTHS.get(field.name)
        if length is not None:
            number = {"type": "array", "items": number, "minItems": length, "maxItems": length}
        properties.setdefault(field.name, number)
    schema = {"title": KINDS[kind].__name__, "type": "object", "properties": properties}
    return json.dumps(schema | {"required": list(properties)}).encode()


def sample_to_json(sample: TelemetrySample) -> bytes:
    """The sample as one JSON object; floats keep every bit.

    Raises:
        ValueError: a value is not finite.
    """
    return json.dumps(vars(sample), allow_nan=False, separators=(",", ":")).encode()


def sample_from_json(kind: str, data: bytes) -> TelemetrySample:
    """The sample that ``sample_to_json`` wrote.

    Raises:
        ValueError: the data are not such a sample.
    """
    return sample_from_values(kind, json.loads(data))


def sample_from_values(kind: str, values: Mapping[str, Any]) -> TelemetrySample:
    """The sample that a parsed JSON object holds.

    Raises:
        ValueError: it holds no such sample.
    """
    try:
        sample_type = KINDS[kind]
        known = {name: values[name] for name in (*STAMP, *VALUES[sample_type])}
        for name, length in LENGTHS.items():
            if name in known:
                known[name] = tuple(float(value) for value in known[name])
                if len(known[name]) != length:
                    raise ValueError(f"{name} holds {len(known[name])} values, not {length}")
    except (KeyError, TypeError) as error:
        raise ValueError(f"not a sample of kind {kind}") from error
    return sample_type(**known)


# --------------------------------------------------------------------------------------------------
# The file of a dive.

log = logging.getLogger(__name__)

NAME = "telemetry.jsonl"
"""The file in a dive folder."""
LONGEST_LINE = 4096
"""bytes; the longest sample takes 250 and the name of its source. What is longer is damaged."""


def to_line(sample: TelemetrySample) -> bytes:
    """The sample as a line.

    Raises:
        ValueError: a value is not finite.
    """
    return b'{"kind":"%b",%b\n' % (KIND_OF[type(sample)].encode(), sample_to_json(sample)[1:])


def of_line(line: bytes) -> TelemetrySample:
    """The sample that ``to_line`` wrote.

    Raises:
        ValueError: the line is not such a sample.
    """
    try:
        values = json.loads(line)
        return sample_from_values(values["kind"], values)
    except (KeyError, TypeError, RecursionError) as error:
        raise ValueError("not a sample of telemetry") from error


class TelemetryLines:
    """Reads a file of samples; every pass begins anew."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damaged = 0
        """Lines of the last pass that are no samples."""

    def samples(self) -> Iterator[TelemetrySample]:
        """The samples, in the order of arrival.

        Raises:
            OSError: the file cannot be read.
        """
        self.damaged = 0
        with open_regular(self.path) as stream:
            while line := stream.readline(LONGEST_LINE):
                try:
                    sample = of_line(line)
                except ValueError:
                    self.damaged += line.endswith(b"\n") or len(line) < LONGEST_LINE
                    continue
                yield sample


class TelemetryWriter:
    """Appends samples to a file; a full disk costs the samples that it does not take."""

    def __init__(self, path: Path) -> None:
        """Append to ``path``, or create it.

        Raises:
            OSError: it cannot be opened.
        """
        self.path = path
        self.lost = 0
        """Samples that found no room."""
        cut_short = is_cut_short(path)
        self._stream = open_to_append(path)
        self._full = False
        if cut_short:  # what follows begins a line of its own
            self._stream.write(b"\n")

    def add(self, samples: Iterable[TelemetrySample]) -> None:
        """Write samples, and give them to the operating system; one that is not finite is left
        out."""
        for sample in samples:
            try:
                self._stream.write(to_line(sample))
            except ValueError as error:
                log.warning("a sample of '%s' was not kept: %s", sample.source, error)
            except OSError:
                self.lost += 1
        try:
            self._stream.flush()
        except OSError as error:
            if not self._full:
                log.warning("%s takes no more for now: %s", self.path.name, error.strerror)
            self._full = True
        else:
            self._full = False

    def close(self) -> None:
        """Close the file; may be called again."""
        with contextlib.suppress(OSError):  # lines that a full disk did not take
            self._stream.close()
