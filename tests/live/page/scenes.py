"""A dive as the page is shown it: report, path and picture, and buttons that change its state."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from aquaflow.survey.coverage.live_coverage import describe
from aquaflow.survey.coverage.page_view import PageView
from aquaflow.survey.coverage.picture import cells_png, coverage_png
from aquaflow.web import HttpRequest, HttpResponse
from tests.live.health.reports import REPORT
from tests.survey.coverage.surveys import survey_of

ROOT = Path(__file__).resolve().parents[3]
NEXT = {
    "start": ({"idle", "paused"}, "mapping"),
    "stop": ({"mapping"}, "paused"),
    "finish": ({"mapping", "paused"}, "idle"),
    "new": ({"idle", "mapping", "paused"}, "mapping"),
}


class SimulatedDive:
    """What the page's server asks."""

    def __init__(self) -> None:
        self.state, self.frames = "mapping", 1834
        self.asked: list[str] = []
        """Actions in the order of the clicks."""
        self.refusal = ""
        """Why nothing that is asked for can be done."""
        self.coverage: PageView | None = None
        """What the camera has seen; None: a server without coverage."""
        self.controlled = True
        """False: a server without the requests that control a dive."""

    def report(self) -> dict[str, Any]:
        sources = {
            "dvl velocity": {"used": 410, "rejected": 2, "reason": ""},
            "gps position": {"used": 0, "rejected": 0, "reason": "no fix under water"},
        }
        frame = {
            "metric": True, "metres_per_map_unit": 1.42, "scale_sigma": 0.018,
            "scale_source": "dvl", "level": True, "gravity_sigma_deg": 0.4,
            "north": "magnetic north", "sources": sources,
        }  # fmt: skip
        telemetry = {
            "autopilot": {
                "depth": {"value": 12.37, "unit": "m", "age_s": 0.1},
                "attitude": {"value": [1, -4, 214], "unit": "deg roll, pitch, heading", "age_s": 0},
            },
            "dvl": {"altitude": {"value": 1.82, "unit": "m", "age_s": 0.2}},
        }
        devices = {
            "pilot": {"kind": "camera", "state": "streaming", "reason": "", "received": 5502},
            "autopilot": {"kind": "link", "state": "connected", "reason": ""},
            "dvl": {"kind": "link", "state": "waiting", "reason": "nothing heard yet"},
        }
        changes = [
            change(212.0, "starting", "initialising", "no pose yet"),
            change(203.0, "initialising", "tracking", "every frame has a pose"),
            change(94.0, "tracking", "lost", "the newest frames have no pose"),
            change(91.0, "lost", "tracking", "every frame has a pose"),
        ]
        dive = {
            "state": self.state, "name": "dive-20261104-0912", "folder": "/data/dives",
            "begun_utc": "2026-11-04T09:12:07Z", "frames": self.frames,
        }  # fmt: skip
        return REPORT | ({"dive": dive} if self.controlled else {}) | {
            "frames": self.frames, "metric_frame": frame, "telemetry": telemetry,
            "devices": devices, "changes": changes, "level": "full", "gaussians": 48211,
            "keyframes": 96, "viewer": {"host": "0.0.0.0", "port": 8231},
        }  # fmt: skip

    def path(self) -> dict[str, Any]:
        """A lawn mower's path, 12 m wide."""
        points = []
        for line in range(7):
            along = np.linspace(0.0, 12.0, 25)
            for x in along if line % 2 == 0 else along[::-1]:
                points.append([x + 0.2 * math.sin(line + x), 1.4 * line + 0.15 * math.sin(x)])
        plan = {
            "number": 0, "unit": "m", "seen": "from above", "right": "east",
            "up": "magnetic north", "points": points,
        }  # fmt: skip
        now = {"sub_map": 0, "at": points[-1], "ahead": [1.0, 0.1]}
        seen = {} if self.coverage is None else {"coverage": describe(self.coverage)}
        hints = [] if self.coverage is None else ["too fast for the wanted overlap: 41 %"]
        return {"sub_maps": [plan | seen], "now": now, "hints": hints}

    def act(self, action: str) -> tuple[int, dict[str, Any]]:
        """As `POST /dive/...` answers."""
        self.asked.append(action)
        allowed, after = NEXT[action]
        if self.refusal or self.state not in allowed:
            return 409, {"error": self.refusal or f"the dive is {self.state}"}
        self.state = after
        return 202, {"state": self.state, "dive": "dive-20261104-0912"}

    def cover(self) -> None:
        """See what the path's keyframes see from 2 m above the ground."""
        points = np.array(self.path()["sub_maps"][0]["points"])
        self.coverage = survey_of(points)

    def png(self) -> bytes | None:
        return None if self.coverage is None else coverage_png(self.coverage)

    def cells(self, sub_map: int) -> bytes | None:
        return None if self.coverage is None or sub_map else cells_png(self.coverage)

    def picture(self) -> bytes:
        """A JPEG: the first panel of the README's picture, which is a synthetic dive."""
        panels = cv2.imread(str(ROOT / "docs" / "result.png"))
        assert panels is not None
        picture = cv2.resize(panels[45:175, 21:250], (916, 520), interpolation=cv2.INTER_CUBIC)
        return bytes(cv2.imencode(".jpg", picture)[1])


def change(ago_s: float, before: str, after: str, reason: str) -> dict[str, Any]:
    return {"ago_s": ago_s, "before": before, "after": after, "reason": reason}


def with_buttons(answers: type[Any], dive: SimulatedDive) -> type[Any]:
    """The server's answers with the requests that control a dive, and its newest picture."""

    class Controlled(answers):  # type: ignore[misc]
        def data(self, path: str) -> HttpResponse:
            if path == "/picture.jpg":
                return HttpResponse(200, "image/jpeg", dive.picture())
            return super().data(path)

        def answer_post(self, request: HttpRequest) -> HttpResponse:
            if not request.target.startswith("/dive/"):
                return super().answer_post(request)
            if not self.access.allows(request.target, request.headers, request.peer):
                return HttpResponse(403, "application/json", b'{"error": "give the token"}')
            code, said = dive.act(request.target.rpartition("/")[2])
            return HttpResponse(code, "application/json", json.dumps(said).encode())

    return Controlled
