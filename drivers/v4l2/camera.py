"""A V4L2 camera as a live CameraSource."""

from __future__ import annotations

from pathlib import Path

from aquaflow.config.cameras import V4l2Config
from aquaflow.drivers.live import LiveCamera
from aquaflow.drivers.v4l2.capture import V4l2Capture
from aquaflow.drivers.v4l2.discovery import explained, find_camera
from aquaflow.drivers.v4l2.pixels import STREAMED
from aquaflow.drivers.v4l2.streamed import StreamedCapture
from aquaflow.drivers.v4l2.system import Kernel, KernelInterface


class V4l2Camera(LiveCamera):
    """The camera with the id in its config, wherever it is plugged in this time."""

    def __init__(
        self,
        name: str,
        config: V4l2Config,
        system: KernelInterface | None = None,
        root: Path = Path("/"),
    ) -> None:
        self._system = system or Kernel()
        self._root = root
        self._v4l2 = config
        super().__init__(name, config, self._open_device)

    @classmethod
    def configured(cls, name: str, config: V4l2Config) -> V4l2Camera:
        """The camera of :func:`aquaflow.sources.open_camera`."""
        return cls(name, config)

    def _open_device(self) -> V4l2Capture | StreamedCapture:
        node = find_camera(self._system, self._v4l2.device, self._root)
        try:
            capture = V4l2Capture(self._system, str(node.path), self._v4l2)
        except OSError as error:
            raise explained(error, node.path) from error
        if capture.settled.pixels != STREAMED:
            return capture
        return StreamedCapture(capture, self._v4l2.stall_s)
