"""Foxglove's websocket server with the topics of a dive."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from aquaflow.base.errors import InputError
from aquaflow.config.service import FoxgloveConfig
from aquaflow.dive.ros.definitions import (
    MESSAGE_ENCODING,
    SCHEMA_ENCODING,
    definition,
    encoded,
    require_rosbags,
)
from aquaflow.dive.ros.topics import OF_FINISHED_DIVES, TYPES

BACKLOG = 32
"""Messages that wait for one client, a few MB; of more its oldest are dropped: it sees less, and
nobody waits."""


class FoxgloveServer:
    """Sends messages to whoever has subscribed; ``send`` never waits for a client."""

    def __init__(self, config: FoxgloveConfig, name: str) -> None:
        """Begin to listen.

        Raises:
            InputError: a library is missing, or the address is taken.
        """
        require_rosbags()
        if find_spec("foxglove") is None:
            raise InputError(
                "service.foxglove.enabled needs foxglove-sdk; install it: pip install "
                "'aquaflow[foxglove,recording]'"
            )
        import foxglove

        self._context = context = foxglove.Context()  # gone with it, channels would be silent
        # Before there can be a client: one that subscribes while channels are made is not heard.
        self._channels = {
            topic: foxglove.Channel(
                topic,
                schema=foxglove.Schema(name=kind, encoding=SCHEMA_ENCODING, data=definition(kind)),
                message_encoding=MESSAGE_ENCODING,
                context=context,
            )
            for topic, kind in TYPES.items()
            if topic not in OF_FINISHED_DIVES
        }
        try:
            self._server: Any = foxglove.start_server(
                name=name, host=config.host, port=config.port, context=context,
                message_backlog_size=BACKLOG,
            )  # fmt: skip
        except (RuntimeError, OSError, ValueError) as error:
            raise InputError(
                f"cannot listen on {config.host}:{config.port} for Foxglove; choose another "
                "service.foxglove.port, or stop what listens there"
            ) from error
        self.port = int(self._server.port)

    def wanted(self, topic: str) -> bool:
        """True while a client has subscribed to it."""
        return bool(self._channels[topic].has_sinks())

    def send(self, topic: str, t_ns: int, message: Any) -> None:
        """Queue a message for every client that has subscribed."""
        channel = self._channels[topic]
        if channel.has_sinks():
            channel.log(encoded(message), log_time=t_ns)

    def close(self) -> None:
        """Let the clients go."""
        for channel in self._channels.values():
            channel.close()
        self._server.stop()
