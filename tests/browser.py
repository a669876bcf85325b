"""A headless Chromium, driven through ChromeDriver by W3C WebDriver (JSON over HTTP)."""

from __future__ import annotations

import base64
import http.client
import json
import shutil
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import pytest

from tests.small_recording import GIVE_UP_S

Place: TypeAlias = tuple[float, float]

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--hide-scrollbars",
)
WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""In place of --disable-gpu, where a page draws by WebGL: on the processor."""
WEBGPU = ("--enable-unsafe-webgpu", "--enable-features=Vulkan", "--use-vulkan=swiftshader")
"""Besides, where it may draw by WebGPU. With fewer of them there is an adapter too, whose device is
lost at the first picture."""
AS_GPU = """
    if (globalThis.GPUAdapterInfo) Object.defineProperty(
      GPUAdapterInfo.prototype, 'isFallbackAdapter', { get: () => false, configurable: true });"""
"""A page may draw by SwiftShader's adapter as by a GPU's."""
ELEMENT = "element-6066-11e4-a52e-4f735466cecf"
"""Key under which WebDriver names an element."""

needs_browser = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None,
    reason="no chromium and chromedriver here: apt-get install chromium chromium-driver",
)


class Browser:
    """One window with a new, empty profile."""

    def __init__(self, profile: Path, webgl: bool = False, webgpu: bool = False) -> None:
        """``webgpu``: beside WebGL, on an adapter that passes for a GPU."""
        assert CHROMIUM is not None
        assert DRIVER is not None
        with socket.create_server(("127.0.0.1", 0)) as probe:
            self._port = int(probe.getsockname()[1])
        self._process = subprocess.Popen(
            [DRIVER, f"--port={self._port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        self.until(self._is_up, "chromedriver")
        draws = webgl or webgpu
        flags = [flag for flag in FLAGS if not draws or flag != "--disable-gpu"]
        drawing = (WEBGL if draws else ()) + (WEBGPU if webgpu else ())
        arguments = [*flags, *drawing, f"--user-data-dir={profile}"]
        options = {"goog:chromeOptions": {"binary": CHROMIUM, "args": arguments}}
        said = self._ask("POST", "/session", {"capabilities": {"alwaysMatch": options}})
        self._session = f"/session/{said['sessionId']}"
        if webgpu:
            self.before(AS_GPU)

    def close(self) -> None:
        self._ask("DELETE", self._session)
        self._process.terminate()
        self._process.wait(GIVE_UP_S)

    def open(self, address: str) -> None:
        self._ask("POST", f"{self._session}/url", {"url": address})

    def before(self, script: str) -> None:
        """Run a script in each page that is opened from now on, before its own."""
        self._command("Page.addScriptToEvaluateOnNewDocument", {"source": script})

    def forget(self) -> None:
        """All cookies, of whatever host and port."""
        self._command("Network.clearBrowserCookies", {})

    def run(self, script: str, *arguments: object) -> Any:
        """What ``script``, the body of a function, returns."""
        body = {"script": script, "args": list(arguments)}
        return self._ask("POST", f"{self._session}/execute/sync", body)

    def in_frame(self, script: str) -> Any:
        """The same in the page's only frame."""
        frame = {ELEMENT: self._find("iframe")}
        self._ask("POST", f"{self._session}/frame", {"id": frame})
        try:
            return self.run(script)
        finally:
            self._ask("POST", f"{self._session}/frame", {"id": None})

    def wait(self, condition: str) -> None:
        """Until the JavaScript expression is true."""
        self.until(lambda: bool(self.run(f"return Boolean({condition})")), condition)

    def text(self, selector: str) -> str:
        return str(self.run("return document.querySelector(arguments[0]).innerText", selector))

    def click(self, selector: str) -> None:
        """As a person does: once it is seen and not grey."""
        found = f"document.querySelector({json.dumps(selector)})"
        self.wait(f"{found}?.checkVisibility() && !{found}.disabled")
        self._ask("POST", f"{self._session}/element/{self._find(selector)}/click", {})

    def type(self, selector: str, text: str) -> None:
        self._ask("POST", f"{self._session}/element/{self._find(selector)}/value", {"text": text})

    def press(self, key: str) -> None:
        """A key, to whatever has the focus."""
        strokes = [{"type": "keyDown", "value": key}, {"type": "keyUp", "value": key}]
        actions = [{"type": "key", "id": "keyboard", "actions": strokes}]
        self._ask("POST", f"{self._session}/actions", {"actions": actions})

    def tap(self, x: float, y: float) -> None:
        """A click at CSS pixels of the window."""
        for kind in ("mousePressed", "mouseReleased"):
            at = {"type": kind, "x": x, "y": y, "button": "left", "clickCount": 1}
            self._command("Input.dispatchMouseEvent", at)

    def touch(self, x: float, y: float) -> None:
        """A finger put down and lifted."""
        for kind, points in (("touchStart", [{"x": x, "y": y}]), ("touchEnd", [])):
            self._command("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    def swipe(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """A finger put down, moved and lifted, as on a tablet."""
        for kind, at in (("touchStart", start), ("touchMove", end), ("touchEnd", None)):
            points = [] if at is None else [{"x": at[0], "y": at[1]}]
            self._command("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    def two_fingers(
        self, start: tuple[Place, Place], end: tuple[Place, Place], steps: int = 8
    ) -> None:
        """Put two fingers down, move both, and lift them."""
        for kind, share in [("touchStart", 0.0)] + [
            ("touchMove", step / steps) for step in range(1, steps + 1)
        ]:
            points = [
                {"x": a[0] + share * (b[0] - a[0]), "y": a[1] + share * (b[1] - a[1]), "id": number}
                for number, (a, b) in enumerate(zip(start, end, strict=True))
            ]
            self._command("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        self._command("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})

    def emulate(self, width: int, height: int, dark: bool = False) -> None:
        """A screen of this many CSS pixels."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self._command("Emulation.setDeviceMetricsOverride", metrics)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._command("Emulation.setEmulatedMedia", {"features": [scheme]})
        self.wait(f"innerWidth === {width} && innerHeight === {height}")

    def screenshot(self, file: Path) -> None:
        """What the screen shows."""
        file.write_bytes(base64.b64decode(self._ask("GET", f"{self._session}/screenshot")))

    def _command(self, name: str, parameters: dict[str, Any]) -> Any:
        """Of the Chrome DevTools Protocol."""
        body = {"cmd": name, "params": parameters}
        return self._ask("POST", f"{self._session}/goog/cdp/execute", body)

    def _find(self, selector: str) -> str:
        body = {"using": "css selector", "value": selector}
        return str(self._ask("POST", f"{self._session}/element", body)[ELEMENT])

    def _is_up(self) -> bool:
        try:
            return bool(self._ask("GET", "/status")["ready"])
        except OSError:
            return False

    def _ask(self, method: str, path: str, body: dict[str, Any] | None = None) -> Any:
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=GIVE_UP_S)
        connection.request(method, path, None if body is None else json.dumps(body))
        said = json.loads(connection.getresponse().read())["value"]
        connection.close()
        if isinstance(said, dict) and "error" in said:
            raise AssertionError(f"{said['error']}: {said['message']}")
        return said

    @staticmethod
    def until(condition: Callable[[], bool], what: str) -> None:
        """Wait for what the test itself looks at."""
        end_s = time.monotonic() + GIVE_UP_S
        while not condition():
            assert time.monotonic() < end_s, f"waited in vain for {what}"
            time.sleep(0.05)
