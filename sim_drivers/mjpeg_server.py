"""A network camera made of a recording: motion JPEG over HTTP, as cheap IP cameras send it."""

from __future__ import annotations

import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from aquaflow.sim_drivers.camera_feed import CameraFeed, Shot

BOUNDARY = "picture"
"""Separates the pictures of the stream; any word will do."""
JPEG_QUALITY = 95
"""Percent, OpenCV's own default."""

WAIT_S = 0.05
"""Longest wait for a picture before the server looks whether it shall end."""


class MjpegServer:
    """Serves a feed on a free port of this computer to one client at a time, until it is closed."""

    def __init__(self, feed: CameraFeed) -> None:
        self.feed = feed
        self.connections = 0
        self.ending = threading.Event()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(self))
        self._server.daemon_threads = True
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True
        )

    @property
    def url(self) -> str:
        """Address of the stream."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/video"

    def __enter__(self) -> MjpegServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.ending.set()
        self._server.shutdown()
        self._server.server_close()


def _handler(camera: MjpegServer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if not camera.feed.plugged_in:
                self.send_error(HTTPStatus.SERVICE_UNAVAILABLE)
                return
            camera.connections += 1
            self.send_response(HTTPStatus.OK)
            kind = f"multipart/x-mixed-replace; boundary={BOUNDARY}"
            self.send_header("Content-Type", kind)
            self.end_headers()
            try:
                while not camera.ending.is_set() and self._send_next():
                    pass
            except (BrokenPipeError, ConnectionResetError):
                return

        def _send_next(self) -> bool:
            """False when the camera was unplugged."""
            if not camera.feed.wait(WAIT_S):
                return True
            shot = camera.feed.take()
            if shot.unplugged:
                return False
            jpeg = _jpeg(shot)
            head = (
                f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            )
            self.wfile.write(head.encode() + jpeg + b"\r\n")
            return True

        def log_message(self, format: str, *args: object) -> None:
            """Silence: a test's output is for its failures."""

    return Handler


def _jpeg(shot: Shot) -> bytes:
    import cv2

    bgr = cv2.cvtColor(shot.image, cv2.COLOR_RGB2BGR)
    _, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if shot.corrupt:
        jpeg = jpeg[: len(jpeg) // 2]
    return bytes(jpeg)
