"""A ROS 2 node that publishes a running dive: tf, poses, path, pictures, points, diagnostics.

    aquaflow run --config my_vehicle.yaml      # service: {foxglove: {enabled: true}}
    python3 aquaflow_node.py                   # beside it, in a sourced ROS 2 environment

AquaFlow sends CDR messages of ROS 2's own types over Foxglove's websocket (docs/live.md#foxglove);
this node hands them on byte for byte, so that nothing is encoded twice. It needs rclpy and
``python3-websockets`` 11 or newer, and nothing of AquaFlow.

Never run under ROS: there is none where AquaFlow is tested. The tests (tests/live/foxglove) read
a running dive with ``Connection``, compare all definitions with ROS's published type hashes, and
let ``republish`` call a stand-in for rclpy. Whether other nodes get the messages was not tried.
"""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Iterator
from typing import Any

from websockets.sync.client import connect

ADDRESS = "ws://127.0.0.1:8765"
PROTOCOL = "foxglove.sdk.v1"
MESSAGE_DATA, MESSAGE_HEADER = 1, struct.Struct("<BIQ")
"""Opcode; opcode, subscription and time (ns) before a message's bytes."""
LASTING = ("/tf_static", "/aquaflow/path", "/aquaflow/points")
"""Kept for nodes that come later (transient local)."""


class Connection:
    """All topics of a running dive."""

    def __init__(self, address: str = ADDRESS) -> None:
        # Points and pictures are larger than the library's limit of a message.
        self._socket = connect(address, subprotocols=[PROTOCOL], max_size=None)
        self.channels: dict[int, dict[str, Any]] = {}
        """By number: ``topic``, ``schemaName``, ``schema``, ``encoding`` and ``schemaEncoding``."""

    def messages(self, wait_s: float | None = None) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time (ns since 1970) and CDR bytes of each message, until the dive's service ends.

        Raises TimeoutError after ``wait_s`` without anything.
        """
        while True:
            received = self._socket.recv(wait_s)
            if isinstance(received, str):
                self._told(json.loads(received))
            elif received[0] == MESSAGE_DATA:
                _, number, t_ns = MESSAGE_HEADER.unpack_from(received)
                yield self.channels[number]["topic"], t_ns, received[MESSAGE_HEADER.size :]

    def _told(self, said: dict[str, Any]) -> None:
        if said["op"] == "advertise":
            new = {channel["id"]: channel for channel in said["channels"]}
            self.channels |= new
            wanted = [{"id": number, "channelId": number} for number in new]
            self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def close(self) -> None:
        self._socket.close()


def republish(connection: Connection, node: Any, wait_s: float | None = None) -> None:
    """Hand every message on to a publisher of its type, made when its first message comes."""
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from rosidl_runtime_py.utilities import get_message

    publishers: dict[str, Any] = {}
    for topic, _, data in connection.messages(wait_s):
        if topic not in publishers:
            names = {channel["topic"]: channel for channel in connection.channels.values()}
            lasts = topic in LASTING
            durability = DurabilityPolicy.TRANSIENT_LOCAL if lasts else DurabilityPolicy.VOLATILE
            quality = QoSProfile(depth=1 if lasts else 10, durability=durability)
            kind = get_message(names[topic]["schemaName"])
            publishers[topic] = node.create_publisher(kind, topic, quality)
        publishers[topic].publish(data)  # bytes are taken as a serialised message


def main() -> None:
    """The node, until the dive's service ends."""
    import rclpy

    rclpy.init()
    node = rclpy.create_node("aquaflow")
    connection = Connection(*sys.argv[1:2])
    try:
        republish(connection, node)
    finally:
        connection.close()
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
