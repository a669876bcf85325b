"""Payloads of MCAP messages as objects with named fields: protobuf, JSON, and both of ROS."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from aquaflow.recordings.mcap_messages import McapMessage

if TYPE_CHECKING:
    from mcap.records import Schema

Decode = Callable[[bytes], Any]


class UnreadablePayloadError(Exception):
    """A message that cannot be decoded; the text is a reason that follows its topic."""


class Payloads:
    """Decodes messages; what a schema needs is built once."""

    def __init__(self) -> None:
        self._decoders: dict[tuple[str, str, bytes], Decode] = {}

    def decode(self, message: McapMessage) -> Any:
        """The message's fields as attributes.

        Raises:
            UnreadablePayloadError: unknown encoding, or damaged data.
        """
        schema = message.schema
        if schema is None:
            raise UnreadablePayloadError("has no schema")
        key = (message.encoding, schema.name, schema.data)
        try:
            if key not in self._decoders:
                self._decoders[key] = _decoder(message.encoding, schema)
            return self._decoders[key](message.data)
        except UnreadablePayloadError:
            raise
        except Exception as error:  # each library has errors of its own
            raise UnreadablePayloadError(f"cannot be decoded as {schema.name}") from error


def _decoder(encoding: str, schema: Schema) -> Decode:
    if encoding == "protobuf":
        from mcap_protobuf.decoder import DecoderFactory

        decode = DecoderFactory().decoder_for(encoding, schema)
        if decode is not None:
            return decode
    if encoding == "json":
        return _from_json
    if encoding in ("ros1", "cdr"):
        return _ros(encoding, schema)
    raise UnreadablePayloadError(f"is encoded as '{encoding}'")


def _from_json(data: bytes) -> Any:
    """foxglove's JSON has bytes in base64."""
    fields = json.loads(data)
    if isinstance(fields.get("data"), str):
        try:
            fields["data"] = base64.b64decode(fields["data"], validate=True)
        except binascii.Error as error:
            raise UnreadablePayloadError("holds data that are not base64") from error
    return SimpleNamespace(**fields)


def _ros(encoding: str, schema: Schema) -> Decode:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    package, _, name = schema.name.replace("/msg/", "/").partition("/")
    typename = f"{package}/msg/{name}"
    if typename not in store.fielddefs:
        store.register(get_types_from_msg(schema.data.decode(), typename))
    read = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    return lambda data: read(data, typename)
