"""``report.html``: one file that explains a dive and opens without a network."""

from aquaflow.survey.report.data import (
    CameraSummary,
    DepthProfile,
    HeldOutExample,
    LeftOut,
    Measures,
    MediumCurves,
    PathPlot,
    ReefRow,
    ReportData,
)
from aquaflow.survey.report.page import render_report, write_report

__all__ = [
    "CameraSummary",
    "DepthProfile",
    "HeldOutExample",
    "LeftOut",
    "Measures",
    "MediumCurves",
    "PathPlot",
    "ReefRow",
    "ReportData",
    "render_report",
    "write_report",
]
