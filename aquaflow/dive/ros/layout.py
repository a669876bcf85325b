"""The layout that Foxglove and Lichtblick show a dive with: map and path, pictures, plots."""

from __future__ import annotations

from typing import Any

from aquaflow.dive.ros.frames import MAP
from aquaflow.dive.ros.topics import (
    ALTITUDE,
    CAMERA,
    CAMERA_INFO,
    DEPTH,
    DIAGNOSTICS,
    HEADING,
    PATH,
    POINTS,
    POSE,
    QUALITY,
    RENDERED,
    RESTORED,
    SPEED,
)

COLOURS = ("#4e98e2", "#f5774d", "#f7df71", "#5cd6a9")
"""Of the lines of a plot, one after the other."""


def layout(picture: str, beside: str) -> dict[str, Any]:
    """The layout as JSON; ``picture`` and ``beside`` are the topics of its two pictures."""
    panels = {
        "3D!map": _scene(),
        "Image!picture": _image(picture),
        "Image!beside": _image(beside),
        "Plot!place": _plot([DEPTH, ALTITUDE, SPEED]),
        "Plot!heading": _plot([HEADING]),
        "Plot!quality": _plot([QUALITY]),
        "DiagnosticSummary!states": {"topicToRender": DIAGNOSTICS, "sortByLevel": True},
    }
    right = _column(["Image!picture", "Image!beside"])
    below = _row(["Plot!place", "Plot!heading", "Plot!quality", "DiagnosticSummary!states"])
    above = {"first": "3D!map", "second": right, "direction": "row", "splitPercentage": 60}
    whole = {"first": above, "second": below, "direction": "column", "splitPercentage": 70}
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": whole,
    }


def pictures(recorded: bool, has_water: bool) -> tuple[str, str]:
    """The two topics to show: what the dive has of camera, render and restored picture."""
    first = CAMERA if recorded else RENDERED
    return first, RESTORED if has_water else RENDERED


def _scene() -> dict[str, Any]:
    """The map and the path from above and aside."""
    return {
        "followTf": MAP,
        "followMode": "follow-none",
        "scene": {"transforms": {"axisScale": 0.3}, "backgroundColor": "#101418"},
        "cameraState": {
            "distance": 12, "phi": 50, "thetaOffset": 45, "fovy": 45, "near": 0.01, "far": 5000,
            "target": [0, 0, 0], "targetOffset": [0, 0, 0], "targetOrientation": [0, 0, 0, 1],
            "perspective": True,
        },
        "topics": {
            POINTS: {"visible": True, "colorField": "rgb", "colorMode": "rgb", "pointSize": 3},
            PATH: {"visible": True, "gradient": ["#5cd6a9ff", "#5cd6a9ff"], "lineWidth": 0.02},
            POSE: {"visible": True, "type": "axis", "axisScale": 0.5, "showCovariance": True},
            CAMERA_INFO: {"visible": True, "distance": 0.5, "width": 0.01},
        },
        "layers": {"grid": {"layerId": "foxglove.Grid", "frameId": MAP, "size": 20}},
    }  # fmt: skip


def _image(topic: str) -> dict[str, Any]:
    return {"imageMode": {"imageTopic": topic, "calibrationTopic": CAMERA_INFO}}


def _plot(topics: list[str]) -> dict[str, Any]:
    lines = [
        {
            "value": f"{topic}.data", "label": topic.rpartition("/")[2], "enabled": True,
            "timestampMethod": "receiveTime", "color": COLOURS[number % len(COLOURS)],
        }
        for number, topic in enumerate(topics)
    ]  # fmt: skip
    return {
        "paths": lines, "showLegend": True, "legendDisplay": "top", "xAxisVal": "timestamp",
        "showXAxisLabels": True, "showYAxisLabels": True, "isSynced": True,
    }  # fmt: skip


def _column(panels: list[str]) -> dict[str, Any]:
    return {
        "first": panels[0], "second": panels[1], "direction": "column", "splitPercentage": 50
    }  # fmt: skip


def _row(panels: list[str]) -> Any:
    """The panels side by side, each as wide as the others."""
    if len(panels) == 1:
        return panels[0]
    return {
        "first": panels[0], "second": _row(panels[1:]), "direction": "row",
        "splitPercentage": 100 / len(panels),
    }  # fmt: skip
