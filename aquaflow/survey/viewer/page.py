"""One page with a scene and its tools; a slow browser never slows the caller."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.config.service import ViewerConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.viewer.client import ClientFile, client_file
from aquaflow.survey.viewer.levels import Palette
from aquaflow.survey.viewer.measuring import LengthUnit
from aquaflow.survey.viewer.moments import unknown
from aquaflow.survey.viewer.packing import Packed, PackedFile
from aquaflow.survey.viewer.seen_water import SeenWater
from aquaflow.survey.viewer.splats import ViewerSplats
from aquaflow.survey.viewer.tools import Tools
from aquaflow.survey.viewer.viewer_content import (
    POSE_NUMBERS,
    PathPart,
    ShownCamera,
    ShownMap,
    ViewerContent,
)
from aquaflow.types import CameraModel
from aquaflow.web import HttpRequest, HttpResponse, WebServer
from aquaflow.web.access import Access, path_of

Float = npt.NDArray[np.floating[Any]]

WATCHED_S = 10.0
"""After its last question a browser is gone: it asks twice a second."""
UP, FIRST_CAMERA_UP = (0.0, 0.0, -1.0), (0.0, -1.0, 0.0)
"""Of a world with a vertical, and of one without."""


class ViewerPage:
    """A page at ``address``, which a browser asks again and again for what is new until it is
    finished; everything shown replaces what was shown before."""

    def __init__(
        self,
        config: ViewerConfig,
        title: str,
        tools: Tools | None = None,
    ) -> None:
        """Listen at once.

        Args:
            tools: what else than pointing and measuring this dive offers.

        Raises:
            InputError: the address is taken.
            ConfigError: the token will not do.
        """
        self._exhibit = ViewerContent(title, FIRST_CAMERA_UP)
        self._tools = tools or Tools()
        self._tools.exhibit = self._exhibit
        self._exhibit.can = self._tools.can()
        self._server = ViewerServer(config, self._exhibit, self._tools.ask)
        host = f"[{config.host}]" if ":" in config.host else config.host
        self.address = f"http://{host}:{self._server.port}/"

    def finish(self) -> None:
        """Nothing more will be shown: a browser need not ask again."""
        self._exhibit.live = False

    def close(self) -> None:
        self._server.close()

    @property
    def watched(self) -> bool:
        """True while a browser asks what is new."""
        return time.monotonic() - self._exhibit.asked_s < WATCHED_S

    @property
    def splats_shown(self) -> int:
        """Number of Gaussians on the page."""
        shown = self._exhibit.map
        return 0 if shown is None else shown.packed.count

    @property
    def packed(self) -> Packed | None:
        """The map as it was packed here; None of one that came packed."""
        shown = self._exhibit.map
        return shown.packed if shown is not None and isinstance(shown.packed, Packed) else None

    def show_splats(
        self,
        splats: ViewerSplats,
        water: SeenWater | None = None,
        palettes: dict[str, Palette] | None = None,
    ) -> None:
        """The map, the water before it, and the palette of each of the splats' levels."""
        self._exhibit.map = ShownMap(lambda: splats, Packed(splats), water, palettes or {})

    def show_packed(
        self,
        packed: Packed | PackedFile,
        splats: Callable[[], ViewerSplats],
        water: SeenWater | None,
        palettes: dict[str, Palette],
    ) -> None:
        """A map as browsers get it; ``splats`` are its Gaussians for who points at them."""
        self._exhibit.map = ShownMap(splats, packed, water, palettes)

    def show_path(
        self,
        poses: Float,  # [N, 8] place, rotation wxyz from the camera, quality in [0, 1]
        moments: Float | None = None,  # [N, 5] as aquaflow/survey/viewer/moments.py has them
        began: datetime | None = None,
        parts: Sequence[PathPart] = (),
    ) -> None:
        """The trajectory, with how well each pose is known, and what else is known of its moments;
        ``began``: UTC of the first one; ``parts``: of several dives, whose seconds each begin at
        0."""
        rows = np.asarray(poses, np.float32).reshape(-1, POSE_NUMBERS)
        said = unknown(len(rows)) if moments is None else np.asarray(moments, np.float32)
        self._exhibit.path = np.concatenate([rows, said], axis=1)
        self._exhibit.began, self._exhibit.path_parts = began, tuple(parts)
        self._exhibit.path_number += 1

    def show_camera(
        self,
        T_wc: Sim3,
        camera: CameraModel,
        picture: npt.NDArray[np.uint8] | None,  # [H, W, 3] RGB
    ) -> None:
        """The camera where it is, with what it sees."""
        before = self._exhibit.camera
        number = 0 if before is None else before.number + 1
        self._exhibit.camera = ShownCamera(T_wc, camera, picture, number)

    def show_pictures(self, pictures: Mapping[int, Path]) -> None:
        """What the camera saw, by the frame's index, where that is kept."""
        self._exhibit.pictures = pictures

    def show_health(self, text: str) -> None:
        """The panel's text: paragraphs."""
        self._exhibit.health = text

    def set_frame(self, frame: LengthUnit, north: str = "") -> None:
        """The unit of lengths, how well it is known, and whether the world has a vertical: else up
        is the first camera's, whose y points down. ``north``: what headings begin at."""
        self._exhibit.north = north
        self._tools.frame = frame
        self._exhibit.unit, self._exhibit.metres = frame.scale.unit, frame.metres
        self._exhibit.up = UP if frame.has_vertical else FIRST_CAMERA_UP


# --------------------------------------------------------------------------------------------------
# What the viewer's web server answers, in threads that nobody waits for.
#
# Every request is let in by :mod:`aquaflow.web.access`, and only our own page may change anything.

log = logging.getLogger(__name__)

MOST_BYTES = 65_536
"""Of a request's body: a measurement of a thousand points."""

JSON, BINARY, JPEG, TEXT = (
    *("application/json", "application/octet-stream", "image/jpeg", "text/plain; charset=utf-8"),
)
NO_STORE, FOR_EVER, ASK_FIRST = (
    "no-store",
    "private, max-age=31536000, immutable",
    "private, no-cache",
)
"""Of what changes; of a chunk, whose address names its content; of the page's files (RFC 9111)."""
POLICY = (
    "default-src 'none'; script-src 'self'; worker-src 'self'; style-src 'self'; "
    "img-src 'self' data: blob:; connect-src 'self'; form-action 'none'; base-uri 'none'; "
    "frame-ancestors 'none'"
)
"""What the page may load (Content Security Policy, Level 3): its own files; and who may show it in
a frame: nobody."""
POLICIES = (
    ("Content-Security-Policy", POLICY), ("X-Content-Type-Options", "nosniff"),
    ("Referrer-Policy", "no-referrer"), ("Cross-Origin-Resource-Policy", "same-origin"),
)  # fmt: skip

GZIPPED = ("Content-Encoding", "gzip")
Headers: TypeAlias = Sequence[tuple[str, str]]
Ask: TypeAlias = Callable[[str, dict[str, Any]], dict[str, Any]]
"""What a tool says to a request by its name and its JSON object; raises InputError."""


class ViewerServer:
    """Serves an exhibit and its tools at the configured address."""

    def __init__(self, config: ViewerConfig, exhibit: ViewerContent, ask: Ask) -> None:
        """Listen at once.

        Raises:
            InputError: the address is taken, or the token file cannot be read.
            ConfigError: the token will not do.
        """
        self._access, self._exhibit, self._ask = Access(config), exhibit, ask
        self._server = WebServer(config, self._access, self._answer, "viewer", MOST_BYTES)
        self.port = self._server.port

    def close(self) -> None:
        """Stop listening."""
        self._server.close()

    def _answer(self, request: HttpRequest) -> HttpResponse:
        return self._tool(request) if request.method == "POST" else self._answer_get(request)

    def _answer_get(self, request: HttpRequest) -> HttpResponse:
        path = path_of(request.target) or ""
        shown = request.target, request.headers, request.peer
        if not self._access.allows(*shown):
            return _of(403, TEXT, b"Give the token\n")
        if self._access.by_query(*shown):  # into a cookie, and out of the address bar
            to = [("Location", _own(path)), ("Set-Cookie", self._access.cookie())]
            return _of(303, TEXT, b"", to)
        if (file := client_file(path)) is not None:
            return _file(file, request.headers.get("if-none-match"))
        if path == "/scene.json":
            return _reply(200, self._exhibit.scene())
        return self._data(path.split("/")[1:]) or _reply(404, {"error": "there is nothing here"})

    def _tool(self, request: HttpRequest) -> HttpResponse:
        """Its name is the path, its arguments the JSON object in the body."""
        given = _parse_body(request.body)
        if not self._access.may_change(request.headers, request.peer):
            return _reply(403, {"error": "open the viewer with its token, and ask from its page"})
        if given is None:
            return _reply(400, {"error": "this is no request of the viewer's page"})
        try:
            return _reply(200, self._ask((path_of(request.target) or "").lstrip("/"), given))
        except InputError as error:
            return _reply(422, {"error": str(error)})
        except Exception:  # whatever a browser asked for, the dive goes on
            log.exception("the viewer could not answer a request")
            return _reply(500, {"error": "that failed; the log of the viewer says why"})

    def _data(self, parts: list[str]) -> HttpResponse | None:
        """None if there is nothing by this name."""
        name, rest = parts[0], parts[1:]
        if name == "map" and len(rest) == 2 and _is_number(rest[1]):
            packed = self._exhibit.chunk(rest[0], int(rest[1]))
            return None if packed is None else _of(200, BINARY, packed, [GZIPPED], FOR_EVER)
        if name == "tile" and len(rest) == 3 and _is_number(rest[1]) and _is_number(rest[2]):
            tile = self._exhibit.tile(rest[0], int(rest[1]), int(rest[2]))
            return None if tile is None else _of(200, BINARY, tile, [GZIPPED], FOR_EVER)
        if name == "path" and len(rest) == 1:
            return _of(200, BINARY, self._exhibit.path.astype("<f4").tobytes())
        if name == "picture" and rest == ["newest"]:
            newest = self._exhibit.newest_picture()
            return None if newest is None else _of(200, JPEG, newest)
        if name == "picture" and len(rest) == 1 and _is_number(rest[0]):
            kept = self._exhibit.picture(int(rest[0]))
            return None if kept is None else _of(200, JPEG, kept, (), ASK_FIRST)
        return None


def _file(file: ClientFile, known: str | None) -> HttpResponse:
    """``known``: the tag that the browser has."""
    headers = [("ETag", file.tag)]
    if known == file.tag:
        return _of(304, file.kind, b"", headers, ASK_FIRST)
    return _of(200, file.kind, file.packed, [*headers, GZIPPED], ASK_FIRST)


def _parse_body(body: bytes | None) -> dict[str, Any] | None:
    """The JSON object that was posted; None for anything else."""
    try:
        given = json.loads(body or b"")
    except (ValueError, RecursionError):
        return None
    return given if isinstance(given, dict) else None


def _reply(code: int, said: dict[str, Any]) -> HttpResponse:
    return _of(code, JSON, json.dumps(said).encode())


def _of(
    code: int, kind: str, data: bytes, headers: Headers = (), keep: str = NO_STORE
) -> HttpResponse:
    always = [("Cache-Control", keep), *POLICIES]
    return HttpResponse(code, kind, data, [*always, *headers])


def _own(path: str) -> str:
    """Where a browser is sent back to: on this server, and without what ends a header."""
    safe = path.startswith("/") and not path.startswith("//") and path.isprintable()
    return path if safe and "\\" not in path else "/"


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) < 10
