"""Telemetry samples as JSON messages with a JSON schema each; reading back gives equal samples."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from aquaflow.types import KINDS, LENGTHS, STAMP, VALUES, TelemetrySample


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
