"""Recording a dive so that nothing but its last second can be lost."""

from aquaflow.live.recorder.recorder import Recorder
from aquaflow.live.recorder.status import RecorderStatus

__all__ = ["Recorder", "RecorderStatus"]
