"""What survey makes of every dive, behind entry points: overview, numbers, report.

What loads torch is imported when a map is there, so that a dive without one never does.
"""

from __future__ import annotations

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.dive.deliverables import Deliverable, DeliverablePhase
from aquaflow.dive.dive import Dive
from aquaflow.survey.export.ortho.ground import NO_OVERVIEW, OVERVIEW
from aquaflow.survey.measure.finished_dive import numbers_at_the_end
from aquaflow.survey.measure.reef_numbers import write_reef_numbers
from aquaflow.survey.report.page import write_report
from aquaflow.survey.report.report_of import report_of


class Overview(Deliverable):
    """overview.png: the map from above, for the report; none where nothing says what is above."""

    stage = "drawing the overview"

    def make(self, dive: Dive, until: Deadline) -> None:
        """A dive with an empty map has none."""
        mapper = dive.maps.get(dive.main)
        if mapper is None or not mapper.views or not len(mapper.gaussians):
            return
        from aquaflow.survey.export.ortho.survey import overview_png

        try:
            picture = overview_png(mapper, dive.frame)
        except InputError as error:
            self.notes = [f"{NO_OVERVIEW}: {error}"]
            return
        with atomic_write(dive.file(OVERVIEW)) as stream:
            stream.write(picture)


class ReefFiles(Deliverable):
    """reef_numbers.json and reef_numbers.csv; what is of the ground, for which every view is drawn,
    within the time."""

    phase = DeliverablePhase.MEASURE
    stage = "reef numbers"

    def make(self, dive: Dive, until: Deadline) -> None:
        """Files of the largest sub-map."""
        write_reef_numbers(dive.path, numbers_at_the_end(dive, until))


class Report(Deliverable):
    """report.html."""

    phase = DeliverablePhase.REPORT
    stage = "report"

    def refresh(self, dive: Dive) -> None:
        """Write the report of the moment."""
        write_report(dive.file("report.html"), report_of(dive))

    def make(self, dive: Dive, until: Deadline) -> None:
        """Write the report of everything."""
        self.refresh(dive)
