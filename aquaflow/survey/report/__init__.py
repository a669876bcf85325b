"""``report.html``: one file that explains a dive and opens without a network."""

from aquaflow.survey.report.data import (
    CameraSummary,
    HeldOutExample,
    LeftOut,
    Measures,
    MediumCurves,
    PathPlot,
    Profile,
    ReefRow,
    ReportData,
)
from aquaflow.survey.report.page import render_report, write_report

__all__ = [
    "CameraSummary",
    "HeldOutExample",
    "LeftOut",
    "Measures",
    "MediumCurves",
    "PathPlot",
    "Profile",
    "ReefRow",
    "ReportData",
    "render_report",
    "write_report",
]
