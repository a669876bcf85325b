"""What the camera has seen, in a plan view: how well each place, along which lines, what next."""

from aquaflow.coverage.classes import COLOURS, WORDS, Seen
from aquaflow.coverage.dive_coverage import DiveCoverage
from aquaflow.coverage.footprint import Footprint
from aquaflow.coverage.next_line import LineState, Suggestion
from aquaflow.coverage.page_view import PageView, page_view
from aquaflow.coverage.plan import CoveragePlan
from aquaflow.coverage.sub_map_coverage import SubMapCoverage
from aquaflow.coverage.water_range import mapping_range, visibility

__all__ = [
    "COLOURS",
    "WORDS",
    "CoveragePlan",
    "DiveCoverage",
    "Footprint",
    "LineState",
    "PageView",
    "Seen",
    "SubMapCoverage",
    "Suggestion",
    "mapping_range",
    "page_view",
    "visibility",
]
