"""Prometheus' text format 0.0.4 (prometheus.io/docs/instrumenting/exposition_formats)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Literal, TypeAlias

TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""Content type of the format."""
Kind: TypeAlias = Literal["counter", "gauge"]


def head(name: str, kind: Kind, help_text: str) -> Iterator[str]:
    """The lines before the samples of a metric, which all follow without a gap."""
    yield f"# HELP aquaflow_{name} {help_text}"
    yield f"# TYPE aquaflow_{name} {kind}"


def sample(name: str, value: float, **labels: str) -> str:
    """One line: a value, and the labels that tell it from the others of its metric."""
    told = ",".join(f'{key}="{_escape(text)}"' for key, text in labels.items())
    return f"aquaflow_{name}{{{told}}} {value}" if told else f"aquaflow_{name} {value}"


def label(
    name: str, label: str, values: Mapping[str, float], help_text: str, kind: Kind = "counter"
) -> Iterator[str]:
    """A metric whose values are told apart by one label."""
    yield from head(name, kind, help_text)
    for text, value in values.items():
        yield sample(name, value, **{label: text})


def _escape(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
