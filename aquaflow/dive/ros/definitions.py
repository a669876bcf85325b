"""ROS 2's message definitions and their CDR encoding, by rosbags: no ROS is needed.

The messages used here have been the same in every ROS 2 release since Humble; a test compares them
with the type hashes (REP-2016) that ROS 2 itself publishes.
"""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from typing import Any

from aquaflow.base.errors import InputError

SCHEMA_ENCODING, MESSAGE_ENCODING = "ros2msg", "cdr"
"""As MCAP and Foxglove's protocol name them."""


def require_rosbags() -> None:
    """Check that messages can be encoded.

    Raises:
        InputError: rosbags is not installed.
    """
    if find_spec("rosbags") is None:
        raise InputError("ROS messages need rosbags; install it: pip install 'aquaflow[recording]'")


@cache
def _store() -> Any:
    require_rosbags()
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def message(name: str, /, **fields: Any) -> Any:
    """A message of the type ``name``, such as ``geometry_msgs/msg/Point``, with all its fields.

    Raises:
        InputError: rosbags is not installed.
    """
    return _store().types[name](**fields)


def constant(name: str, constant: str) -> Any:
    """The value of a constant in a message's definition, such as ``PointField.FLOAT32``."""
    return getattr(_store().types[name], constant)


@cache
def definition(name: str) -> bytes:
    """The definition of ``name`` and of what it refers to, one ``.msg`` text after the other: the
    schema ``ros2msg`` of MCAP."""
    text, _ = _store().generate_msgdef(name, ros_version=2)
    return str(text).encode()


def encode(message: Any) -> bytes:
    """The message as CDR, little endian."""
    return bytes(_store().serialize_cdr(message, message.__msgtype__))
