"""A video as a reader that is not ours has it: Chromium, and the tables of the MP4 file."""

from __future__ import annotations

import contextlib
import functools
import http.server
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.browser import Browser

LOOK = """
return (async () => {
  const video = document.createElement('video');
  const file = await (await fetch(arguments[0])).blob();  // the server cannot seek
  video.muted = true; video.preload = 'auto'; video.src = URL.createObjectURL(file);
  await new Promise((done, failed) => {
    video.onloadeddata = done; video.onerror = () => failed(new Error(video.error.message)); });
  const canvas = document.createElement('canvas');
  canvas.width = video.videoWidth; canvas.height = video.videoHeight;
  const context = canvas.getContext('2d'), pictures = [];
  for (const t of arguments[1]) {
    video.currentTime = t;
    await new Promise(done => { video.onseeked = done; });
    context.drawImage(video, 0, 0);
    const data = context.getImageData(0, 0, canvas.width, canvas.height).data;
    pictures.push(Array.from(data));
  }
  return {width: canvas.width, height: canvas.height, duration: video.duration, pictures};
})();
"""


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of the files in ``folder``."""
    handler = functools.partial(_Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        """Says nothing."""


def played(
    path: Path, profile: Path, times_s: list[float]
) -> tuple[float, list[npt.NDArray[np.uint8]]]:
    """Duration (s), and what Chromium shows at each time [H, W, 3]."""
    (path.parent / "page.html").write_text("<!doctype html><title>video</title>")
    with served(path.parent) as address:
        browser = Browser(profile)
        try:
            browser.open(f"{address}/page.html")
            said = browser.run(LOOK, f"{address}/{path.name}", times_s)
        finally:
            browser.close()
    shape = (said["height"], said["width"], 4)
    pictures = [np.array(data, np.uint8).reshape(shape)[..., :3] for data in said["pictures"]]
    return said["duration"], pictures


def stated_times(path: Path) -> list[float]:
    """Seconds at which each picture begins, by the boxes mdhd and stts of ISO/IEC 14496-12."""
    data = path.read_bytes()
    track = _box(_box(_box(data, b"moov"), b"trak"), b"mdia")
    header = _box(track, b"mdhd")
    (scale,) = struct.unpack(">I", header[12:16])
    table = _box(_box(_box(track, b"minf"), b"stbl"), b"stts")
    (entries,) = struct.unpack(">I", table[4:8])
    times, now = [], 0
    for entry in range(entries):
        count, duration = struct.unpack(">II", table[8 + 8 * entry : 16 + 8 * entry])
        for _ in range(count):
            times.append(now / scale)
            now += duration
    return times


def _box(data: bytes, name: bytes) -> bytes:
    """The content of the first box of this name."""
    at = 0
    while at < len(data):
        (size,) = struct.unpack(">I", data[at : at + 4])
        if data[at + 4 : at + 8] == name:
            return data[at + 8 : at + size]
        assert size >= 8
        at += size
    raise AssertionError(f"no box {name!r}")
