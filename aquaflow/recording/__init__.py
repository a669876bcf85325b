"""Recording a dive so that nothing but its last second can be lost."""

from aquaflow.recording.recorder import Recorder
from aquaflow.recording.status import RecorderStatus

__all__ = ["Recorder", "RecorderStatus"]
