"""A live dive on a device: mapped, shown, cut off, gone on with, and finished there."""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest

from aquaflow.config.service import ViewerConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.live.checkpoint.generations import read_state, state_file
from aquaflow.live.checkpoint.resume import resume_folder
from aquaflow.live.health.degradation import DegradationLevel
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.report import report
from aquaflow.sources import open_recording
from aquaflow.survey.viewer.live_viewer import LiveViewer
from aquaflow.types import Frame
from tests.device.device_scenes import on_host
from tests.device.gsplats_place import machine_with
from tests.device.whole_dives import FRAMES, write_dimmed_dive
from tests.live.live_scenes import ToldFeed, caught_up
from tests.pretended_allocator import DEFAULT_BYTES
from tests.pretended_device import PRETENDED, Device
from tests.small_recording import GIVE_UP_S

pytestmark = [pytest.mark.usefixtures("nothing_strays", "repaired"), pytest.mark.ci]

CUT = 7
"""Frames before the cut."""
FEW = {"steps_keyframe": 2, "steps_mapping": 2, "steps_common": 1, "refine_steps": 4}
VEHICLE = VehicleConfig.model_validate(
    {
        "threads": 1,
        "mapping": {
            "optimiser": FEW,
            "medium": {"fit": False},
            "decoder": {"enabled": True, "local_width": 4, "global_width": 4, "width": 8},
        },
        "service": {
            "health": {"enabled": False, "port": 8230},
            "mapping": {"backlog": 100, "steps_per_view": 0, "nice": 0},
            "checkpoint": {"every_s": 1e6},
            "limits": {"look_s": 1e-6, "calm_s": 1e-6, "memory_share": 0.0, "temperature_c": 200},
        },
    }
)


@pytest.fixture(scope="module")
def frames(device: Device, tmp_path_factory: pytest.TempPathFactory) -> list[Frame]:
    recording = open_recording(write_dimmed_dive(tmp_path_factory.mktemp("live")))
    return [frame for frame in recording.frames() if isinstance(frame, Frame)]


@contextmanager
def live(folder: Path) -> Iterator[LiveDive]:
    """A dive in ``folder``, the one that was cut off there if there is one."""
    with machine_with(PRETENDED):
        dive = LiveDive("live", resume_folder(folder, new=False), ToldFeed(), VEHICLE)
        try:
            assert dive.parts.maps.renderer.device == PRETENDED
            yield dive
        finally:
            dive.close()


@contextmanager
def shown(dive: LiveDive) -> Iterator[LiveViewer]:
    """The dive in a viewer, which takes part in every turn of its loop."""
    config = ViewerConfig(port=0, refresh_s=0.01)
    viewer = LiveViewer(config, lambda: report(dive.parts, 1e6))
    dive.parts.loop.watchers.append(viewer.update)
    try:
        yield viewer
    finally:
        viewer.close()


def test_a_dive_that_was_cut_off_goes_on_on_the_device_and_ends_there(
    device: Device, frames: list[Frame], tmp_path: Path
) -> None:
    folder = tmp_path / "dive"
    with live(folder) as dive, shown(dive) as viewer:
        for frame in frames[:CUT]:
            dive.parts.loop.take(frame)
        caught_up(dive)
        count = len(dive.parts.maps.mappers[0].gaussians)
        until = time.monotonic() + GIVE_UP_S
        while viewer.splats_shown != count and time.monotonic() < until:
            urlopen(f"{viewer.address}scene.json").close()  # a browser looks on
            dive.parts.loop.take(None)
            time.sleep(0.02)
        assert viewer.splats_shown == count > 100
        dive.parts.checkpointer.take()
        caught_up(dive)
        assert dive.parts.checkpointer.taken == 1
    with live(folder) as back:
        mapper, saved = back.parts.maps.mappers[0], read_state(state_file(folder)).arrays
        assert len(mapper.gaussians) == count
        for name, tensor in on_host(mapper).items():
            if name in mapper.gaussians.parameters:
                assert mapper.gaussians.parameters[name].device == PRETENDED
                np.testing.assert_array_equal(tensor, saved[f"mapping.map0.gaussians.{name}"])
        for frame in frames[CUT:]:
            back.parts.loop.take(frame)
        caught_up(back)
        finished = back.parts.run.finish([])
    assert finished.metrics["tracked"] >= FRAMES - 2
    assert finished.metrics["device"] == PRETENDED.type
    assert not finished.metrics["failures"]
    assert finished.metrics["psnr"] > 15.0
    for file in ("map.aqf", "map.ply", "map_clear.ply", "report.html"):
        assert (folder / file).is_file()


def test_less_is_done_while_the_device_has_little_memory_left(
    device: Device, frames: list[Frame], tmp_path: Path
) -> None:
    with live(tmp_path / "dive") as dive:
        loop = dive.parts.loop
        for frame in frames[:CUT]:
            loop.take(frame)
        caught_up(dive)
        assert loop.pressure.gpu_free_share is not None
        gc.collect()  # what earlier tests left there must not be freed from here on
        assert len(dive.parts.maps.mappers[0].gaussians) > 0
        until = time.monotonic() + GIVE_UP_S
        while loop.degradation.level < DegradationLevel.TRACKING_ONLY and time.monotonic() < until:
            # At each look: the mapping thread may only now let go of its last request's tensors.
            device.memory.total = device.memory.allocated + 1
            loop.take(None)
        assert loop.degradation.level is DegradationLevel.TRACKING_ONLY
        assert "of the GPU's memory is left" in loop.degradation.reason
        device.memory.total = DEFAULT_BYTES
        for _ in range(5):
            loop.take(None)
        assert loop.degradation.level is DegradationLevel.FULL
