"""What the pilot hears: whole sentences that fit into one STATUSTEXT, whatever a device is called.

A name that does not fit is left out, never cut. Ground stations speak these texts, so they hold no
numbers, paths or errors; those are in the reason on the service's page.
"""

from __future__ import annotations

from aquaflow.live.health.degradation import DegradationLevel
from aquaflow.live.health.pressure import Shortage
from aquaflow.live.health.state import ServiceState
from aquaflow.sources.outbound import LONGEST_TEXT
from aquaflow.tracking.consistency import Cause

OF_STATE = {
    ServiceState.STARTING: "AquaFlow starts.",
    ServiceState.WAITING: "AquaFlow: no picture from the camera.",
    ServiceState.INITIALISING: "AquaFlow: move sideways over texture to start.",
    ServiceState.TRACKING: "AquaFlow is tracking.",
    ServiceState.LOST: "AquaFlow is lost: go back to a mapped place.",
    ServiceState.DEGRADED: "AquaFlow works with less than everything.",
    ServiceState.INCONSISTENT: "AquaFlow: the map contradicts itself.",
    ServiceState.STOPPING: "AquaFlow stops.",
    ServiceState.IDLE: "AquaFlow waits for a dive to begin.",
    ServiceState.PAUSED: "AquaFlow is paused.",
    ServiceState.FINISHING: "AquaFlow finishes the dive.",
}
"""Of a state by itself."""
OF_CAUSE = {
    Cause.DEPTHS: "AquaFlow: the scale of the map has changed.",
    Cause.POSE: "AquaFlow: the scale of the map is doubtful.",
    Cause.MATCHES: "AquaFlow: few matches fit the map.",
}
"""Why tracking is inconsistent."""
OF_SHORTAGE = {
    Shortage.MEMORY: "low memory",
    Shortage.GPU_MEMORY: "low GPU memory",
    Shortage.HEAT: "too hot",
}
"""Why the service does less."""
OF_LEVEL = {
    DegradationLevel.FEWER_STEPS: "the map grows slower",
    DegradationLevel.SMALLER_IMAGES: "the map is coarser",
    DegradationLevel.TRACKING_ONLY: "the map rests",
    DegradationLevel.RECORDING_ONLY: "it only records",
}
"""What the service still does."""
DISK_FULL = "AquaFlow: the disk is full, nothing is kept."
MAPPING_FAILS = "AquaFlow: the map cannot grow, tracking goes on."
STAGE_FAILS = "AquaFlow: a stage fails again and again."
NOT_RECORDING = "AquaFlow does not record any more."


def no_picture(camera: str) -> str:
    """Of a camera that sends nothing."""
    return _fitting(f"AquaFlow: no picture from camera {camera}.", OF_STATE[ServiceState.WAITING])


def silent_link(name: str, heard_before: bool) -> str:
    """Of a link that was lost, or that was never heard."""
    if heard_before:
        return _fitting(f"AquaFlow: link {name} is lost.", "AquaFlow: a link is lost.")
    return _fitting(f"AquaFlow: nothing heard of {name}.", "AquaFlow: a link is silent.")


def doing_less(level: DegradationLevel, shortage: Shortage) -> str:
    """Of a service that sheds load."""
    return f"AquaFlow: {OF_SHORTAGE[shortage]}, {OF_LEVEL[level]}."


def _fitting(named: str, unnamed: str) -> str:
    return named if len(named) <= LONGEST_TEXT else unnamed
