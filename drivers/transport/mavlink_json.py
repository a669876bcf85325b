"""MAVLink packets to and from the JSON of mavlink2rest (github.com/mavlink/mavlink2rest).

A report has a ``header`` with ``system_id``, ``component_id`` and ``sequence``, and a ``message``
whose ``type`` is the message's name. Its fields are those of MAVLink, but ``type`` is called
``mavtype``, an enumeration is ``{"type": NAME}``, and flags are ``"NAME | NAME"``. Version 0.11 has
``{"bits": number}`` for flags and a list of letters for text. What is not finite is null.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

Report = Mapping[str, Any]


def packet_of(dialect: Any, report: Report) -> bytes:
    """The MAVLink 2 packet of a report.

    Raises:
        LookupError, TypeError, ValueError, struct.error: no such message, or its fields are not as
            MAVLink has them.
    """
    header, body = report["header"], report["message"]
    message = getattr(dialect, f"MAVLink_{body['type'].lower()}_message")
    fields = {}
    for name, kind in zip(message.fieldnames, message.fieldtypes, strict=True):
        key = "mavtype" if name == "type" else name
        if key in body:  # what is missing may be an extension
            fields[name] = _binary(dialect, body[key], kind)
    wire = dialect.MAVLink(None, header["system_id"], header["component_id"])
    wire.seq = header.get("sequence", 0) % 256
    return bytes(message(**fields).pack(wire))


def report_of(dialect: Any, message: Any, template: Report) -> dict[str, Any]:
    """The report of a pymavlink message, in the form that ``template`` shows for its fields; a
    newer service knows more fields, and wants them all."""
    body = dict(template)
    for name in message.fieldnames:
        key = "mavtype" if name == "type" else name
        if key in template:
            names = dialect.enums.get(message.fieldenums_by_name.get(name), {})
            body[key] = _written(getattr(message, name), template[key], names)
    header = message.get_header()
    sender = {"system_id": header.srcSystem, "component_id": header.srcComponent}
    return {"header": {**sender, "sequence": header.seq}, "message": body}


def _binary(dialect: Any, value: Any, kind: str) -> Any:
    """A field's value as pymavlink takes it."""
    if kind == "char":
        return "".join(value).encode("ascii", "replace")
    if isinstance(value, list):
        return [_binary(dialect, each, kind) for each in value]
    if value is None:
        return math.nan
    if isinstance(value, dict):
        value = value["bits"] if "bits" in value else value["type"]
    if isinstance(value, str):
        flags = (getattr(dialect, flag.strip()) for flag in value.split("|") if flag.strip())
        return sum(int(flag) for flag in flags)
    return value


def _written(value: Any, form: Any, names: Mapping[int, Any]) -> Any:
    """A field's value in the form of ``form``; ``names`` are those of its enumeration."""
    if isinstance(form, list):
        if isinstance(value, str | bytes):
            text = value if isinstance(value, str) else value.decode("ascii", "replace")
            return list(text.ljust(len(form), "\0"))
        return [_written(each, 0, names) for each in value]
    if isinstance(form, dict):
        return {"bits": value} if "bits" in form else {"type": names[value].name}
    if isinstance(form, str):
        if isinstance(value, str | bytes):
            return value if isinstance(value, str) else value.decode("ascii", "replace")
        return " | ".join(entry.name for flag, entry in names.items() if value & flag)
    return value
