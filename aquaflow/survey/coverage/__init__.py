"""What the camera has seen, in a plan view: how well each place, along which lines, what next."""

from aquaflow.survey.coverage.classes import COLOURS, WORDS, CoverageClass
from aquaflow.survey.coverage.dive_coverage import DiveCoverage
from aquaflow.survey.coverage.footprint import Footprint, mapping_range, visibility
from aquaflow.survey.coverage.page_view import PageView, page_view
from aquaflow.survey.coverage.plan import CoveragePlan
from aquaflow.survey.coverage.sub_map_coverage import SubMapCoverage
from aquaflow.survey.coverage.survey_lines import LineState, Suggestion

__all__ = [
    "COLOURS",
    "WORDS",
    "CoverageClass",
    "CoveragePlan",
    "DiveCoverage",
    "Footprint",
    "LineState",
    "PageView",
    "SubMapCoverage",
    "Suggestion",
    "mapping_range",
    "page_view",
    "visibility",
]
