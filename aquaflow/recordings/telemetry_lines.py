"""telemetry.jsonl: the telemetry of a live dive, one sample a line, in the order of arrival.

A line is the sample's JSON object with its ``kind``. A line that was cut off, or damaged, costs
itself.
"""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Iterable, Iterator
from pathlib import Path

from aquaflow.base.errors.regular_file import open_regular
from aquaflow.base.storage.atomic import is_cut_short, open_to_append
from aquaflow.recordings.telemetry_json import sample_from_values, sample_to_json
from aquaflow.types import KIND_OF, TelemetrySample

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
