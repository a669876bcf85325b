"""The deliverables at the end of a dive; each part is computed and written separately.

A part that fails is counted and made once more; one that fails again is named in the notes and left
out, and never costs another.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.held_out import HeldOut, examine_held_out, mean_amplification
from aquaflow.dive.report_data import report_data
from aquaflow.dive.results import (
    WaterSummary,
    largest_sub_map,
    refined_poses,
    summarise_water,
    tracked_poses,
)
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.messages import CameraModel, Dropped
from aquaflow.slam import Slam
from aquaflow.tracking.frames import Tracked


class Deliverables:
    """Evaluates a finished dive and writes its files into the dive folder."""

    def __init__(
        self,
        name: str,
        folder: DiveFolder,
        slam: Slam,
        results: list[Tracked],
        calibration: CameraModel | None,
    ) -> None:
        """``results``: all frames with their final poses; ``calibration``: as given, if any."""
        self.name, self.folder, self.slam = name, folder, slam
        self.results, self.calibration = results, calibration
        self.held_out: list[HeldOut] = []
        self.poses: dict[int, Sim3] = tracked_poses(results)
        """By frame index."""
        self._attempt = slam.failures.attempt
        self._main = largest_sub_map(results)
        self._waters: dict[int, WaterSummary | None] = {}
        """By sub-map; a sub-map whose summary failed is missing."""

    def evaluate(self) -> None:
        """Poses as the map refined them, held-out views, and the water of each sub-map."""
        attempt = self._attempt
        refined = attempt("refined poses", lambda: refined_poses(self.slam, self.results))
        self.poses = self.poses if refined is None else refined
        held_out = attempt("evaluation", lambda: examine_held_out(self.slam, self._main))
        self.held_out = [] if held_out is None else held_out
        for sub_map, mapper in self.slam.mappers.items():
            attempt("water summary", partial(self._summarise_water, sub_map, mapper))

    def _summarise_water(self, sub_map: int, mapper: Mapper) -> None:
        self._waters[sub_map] = summarise_water(mapper)

    def write(self, scale_source: str) -> None:
        """Everything but the report and metrics.json."""
        attempt, folder = self._attempt, self.folder
        attempt("writing trajectory.tum", self._write_trajectory)
        camera = self.slam.tracker.camera
        if camera is not None:
            write = partial(folder.write_cameras, camera, self.calibration)
            attempt("writing camera.yaml", write)
        for sub_map in self.slam.mappers:
            self._write_map(sub_map)
        attempt("writing held-out views", partial(folder.write_held_out, self.held_out))
        if self._main in self._waters or not self.slam.mappers:
            attempt("writing medium.json", partial(self._write_medium, scale_source))

    def _write_trajectory(self) -> None:
        times = {tracked.frame.index: tracked.frame.t_ns * 1e-9 for tracked in self.results}
        self.folder.write_trajectory([times[i] for i in self.poses], list(self.poses.values()))

    def _write_medium(self, scale_source: str) -> None:
        mapper = self.slam.mappers.get(self._main)
        evidence = None if mapper is None else mapper.scene.water_evidence
        amplification = mean_amplification(self.held_out)
        water = self._waters.get(self._main)
        self.folder.write_medium(water, scale_source, evidence, amplification)

    def _write_map(self, sub_map: int) -> None:
        suffix = "" if sub_map == self._main else f"_{sub_map}"
        mapper, water = self.slam.mappers[sub_map], self._waters.get(sub_map)
        for file, write in (
            (f"map{suffix}.aqf", partial(self.folder.write_map, mapper, suffix)),
            (f"map{suffix}.ply", partial(self.folder.write_splats, mapper, water, suffix)),
        ):
            self._attempt(f"writing {file}", write)

    def write_report(
        self, dropped: list[Dropped], numbers: dict[str, Any], notes: list[str]
    ) -> None:
        """report.html, with the ``numbers`` of metrics.json."""

        def write() -> None:
            water = self._waters.get(self._main)
            self.folder.write_report(
                report_data(
                    self.name, self.slam, self.results, dropped, self.poses, self.held_out, water,
                    numbers, notes, calibrated=self.calibration is not None,
                )
            )  # fmt: skip

        self._attempt("report", write)
