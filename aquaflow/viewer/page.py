"""One page with a scene and a panel, made by viser; a slow browser never slows the caller."""

from __future__ import annotations

import contextlib
import io
import socket
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from aquaflow.config.viewer import ViewerConfig
from aquaflow.errors import InputError
from aquaflow.geometry.similarity import Sim3
from aquaflow.messages import CameraModel
from aquaflow.viewer.auth_proxy import AuthProxy
from aquaflow.viewer.splats import Splats, heat

Float = npt.NDArray[np.floating[Any]]

LABELS = {
    "water": "as seen through water",
    "clear": "without the water",
    "coverage": "how often it was seen",
}
"""What the colours show, in words."""
FRUSTUM_SHARE = 0.06
"""Size of the camera in the scene, of the scene's own."""
LINE_SHARE = 0.0015
"""Thickness of its lines, likewise."""
VIEW_SHARE, RAISED_SHARE = 0.9, 0.25
"""How far from the map's middle a browser begins, and how far above that, likewise."""


class ViewerPage:
    """A page at ``address``; everything shown replaces what was shown before."""

    def __init__(self, config: ViewerConfig, title: str, up: Literal["-y", "-z"] = "-y") -> None:
        """Listen at once; ``up``: of the world, by default the first camera's, whose y points down.

        Raises:
            InputError: viser is not installed, or the address is taken.
            ConfigError: the token will not do.
        """
        if find_spec("viser") is None:
            raise InputError("the viewer needs viser: pip install 'aquaflow[viewer]'")
        import viser

        with contextlib.redirect_stdout(io.StringIO()):
            self._server: Any = viser.ViserServer("127.0.0.1", _free_port(), title, verbose=False)
        self._proxy = AuthProxy(config, self._server.get_port())
        self.address = f"http://{config.host}:{self._proxy.port}/"
        self._splats: Splats | None = None
        self._size = 1.0
        self._path_middle: Float | None = None
        self._scene = self._server.scene
        self._up = np.array([0.0, -1.0, 0.0] if up == "-y" else [0.0, 0.0, -1.0])
        self._scene.set_up_direction(up)
        self._server.gui.configure_theme(show_logo=False)
        self._panel = self._server.gui.add_markdown("")
        self._shown = self._server.gui.add_dropdown("Colours", tuple(LABELS.values()))
        self._shown.on_update(lambda _: self._draw_splats())

    def close(self) -> None:
        self._proxy.close()
        self._server.stop()

    @property
    def splats_shown(self) -> int:
        """Number of Gaussians on the page."""
        return 0 if self._splats is None else len(self._splats)

    def show_splats(self, splats: Splats) -> None:
        """The map."""
        self._splats = splats
        offered = tuple(LABELS[name] for name in LABELS if name in splats.colours)
        if self._shown.options != offered:
            self._shown.options = offered
        if len(splats):
            low, high = np.percentile(splats.centres, (5, 95), axis=0)
            self._size = max(float(np.linalg.norm(high - low)), 1e-3)
        self._draw_splats()
        self._look()

    def show_path(
        self,
        centres: Float,  # [N, 3]
        quality: Float,  # [N] in [0, 1]
    ) -> None:
        """The trajectory, coloured by how well each pose is known."""
        if len(centres) < 2:
            return
        self._path_middle = np.asarray(centres, np.float64).mean(axis=0)
        self._look()
        points = np.stack([centres[:-1], centres[1:]], axis=1).astype(np.float32)
        colours = np.repeat((255 * heat(quality[1:])).astype(np.uint8)[:, None], 2, axis=1)
        self._scene.add_line_segments("path", points, colours, thickness=0.003 * self._size)

    def show_camera(
        self,
        T_wc: Sim3,
        camera: CameraModel,
        picture: npt.NDArray[np.uint8] | None,  # [H, W, 3] RGB
    ) -> None:
        """The camera where it is, with what it sees: ``picture`` [H, W, 3] RGB."""
        fov = 2.0 * float(np.arctan(0.5 * camera.height / camera.fy))
        self._scene.add_camera_frustum(
            "camera",
            fov,
            camera.width / camera.height,
            scale=FRUSTUM_SHARE * self._size,
            thickness=LINE_SHARE * self._size,
            color=(235, 120, 40),
            image=picture,
            format="jpeg",
            jpeg_quality=80,
            wxyz=T_wc.quaternion,
            position=T_wc.t,
        )

    def show_health(self, markdown: str) -> None:
        """The panel's text."""
        if self._panel.content != markdown:
            self._panel.content = markdown

    def add_slider(self, name: str, count: int, first: int, moved: Any) -> None:
        """A slider over ``count`` items, at the ``first``; ``moved`` gets the number of one."""
        slider = self._server.gui.add_slider(name, 0, max(count - 1, 1), 1, first)
        slider.on_update(lambda _: moved(int(slider.value)))

    def _draw_splats(self) -> None:
        splats = self._splats
        if splats is None or not len(splats):
            return
        wanted = {label: name for name, label in LABELS.items()}.get(self._shown.value, "")
        colours = splats.colours.get(wanted) if wanted else None
        if colours is None:
            colours = next(iter(splats.colours.values()))
        self._scene.add_gaussian_splats(
            "map", splats.centres, splats.covariances, colours, splats.opacities[:, None]
        )

    def _look(self) -> None:
        """Where a browser's own camera begins: behind the path, with the map before it."""
        if self._splats is None or self._path_middle is None or not len(self._splats):
            return
        middle = np.median(self._splats.centres, axis=0).astype(np.float64)
        back = self._path_middle - middle
        back *= VIEW_SHARE * self._size / max(float(np.linalg.norm(back)), 1e-9)
        start = middle + back + self._size * RAISED_SHARE * self._up
        camera = self._server.initial_camera
        camera.look_at = tuple(float(v) for v in middle)
        camera.position = tuple(float(v) for v in start)
        camera.up = tuple(float(v) for v in self._up)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])
