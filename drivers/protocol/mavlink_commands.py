"""Commands of MAVLink to AquaFlow's component (mavlink.io/en/services/command.html).

MAV_CMD_USER_1 to 4, which the standard leaves to each vehicle's maker, are the four requests of a
dive. Each is acknowledged; a repetition, as senders make while no acknowledgement reached them, is
acknowledged as before and not obeyed twice.
"""

from __future__ import annotations

from typing import Any

from aquaflow.drivers.protocol.mavlink_frames import Header
from aquaflow.sources.pilot import Obey, PilotRequest

FIRST_COMMAND = 31010
"""MAV_CMD_USER_1."""
REQUESTS: dict[int, PilotRequest] = {
    FIRST_COMMAND: "start",
    FIRST_COMMAND + 1: "stop",
    FIRST_COMMAND + 2: "finish",
    FIRST_COMMAND + 3: "new",
}
"""By MAV_CMD."""
MESSAGES = frozenset({"COMMAND_LONG", "COMMAND_INT"})
ACCEPTED, REFUSED_NOW, UNSUPPORTED = 0, 1, 3
"""MAV_RESULT."""


class MavlinkCommands:
    """Of one link; without :attr:`asked` it is silent."""

    def __init__(self, dialect: Any, system_id: int, component_id: int) -> None:
        """The numbers are ours: commands to others are theirs."""
        self.asked: Obey | None = None
        self._dialect, self._us = dialect, (system_id, component_id)
        self._answered: tuple[Header, int, int] | None = None
        """Who sent the last command, which one, and its result."""

    def acknowledged(self, header: Header, message: Any) -> Any | None:
        """The COMMAND_ACK of a COMMAND_LONG or COMMAND_INT; None if it is none of ours."""
        if self.asked is None or (message.target_system, message.target_component) != self._us:
            return None
        result = self._result(header, message, self.asked)
        self._answered = header, message.command, result
        return self._dialect.MAVLink_command_ack_message(
            command=message.command,
            result=result,
            target_system=header.system,
            target_component=header.component,
        )

    def _result(self, header: Header, message: Any, asked: Obey) -> int:
        request = REQUESTS.get(message.command)
        if request is None:
            return UNSUPPORTED
        before = self._answered
        if getattr(message, "confirmation", 0) > 0 and before is not None:
            (_, system, component, _), command, result = before
            if (system, component, command) == (header.system, header.component, message.command):
                return result
        return ACCEPTED if asked(request) else REFUSED_NOW
