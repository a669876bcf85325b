"""A video stream as a live CameraSource."""

from __future__ import annotations

from aquaflow.config.cameras import StreamConfig
from aquaflow.drivers.live import LiveCamera
from aquaflow.drivers.stream.opening import open_stream


class StreamCamera(LiveCamera):
    """The newest picture of a stream; connects again whenever it breaks."""

    def __init__(self, name: str, config: StreamConfig) -> None:
        super().__init__(name, config, lambda: open_stream(name, config))

    @classmethod
    def configured(cls, name: str, config: StreamConfig) -> StreamCamera:
        """The camera of :func:`aquaflow.sources.open_camera`."""
        return cls(name, config)
