"""What Prometheus reads, as its own client's parser reads it."""

from __future__ import annotations

import re

from prometheus_client.parser import text_string_to_metric_families

from aquaflow.live.health.http import exposition
from aquaflow.live.health.state import ServiceState
from tests.live.health.reports import REPORT

Read = dict[tuple[str, frozenset[tuple[str, str]]], float]
FRONT, DVL = "front", 'the "dvl"\n'


def read(text: str) -> Read:
    """Every sample by its name and labels."""
    samples = [each for family in text_string_to_metric_families(text) for each in family.samples]
    found = {(each.name, frozenset(each.labels.items())): float(each.value) for each in samples}
    assert len(found) == len(samples), "a sample is there twice"
    return found


def value(metrics: Read, name: str, **labels: str) -> float | None:
    return metrics.get((f"aquaflow_{name}", frozenset(labels.items())))


def test_every_line_is_well_formed_and_every_metric_stands_together() -> None:
    line = re.compile(r'^(# (HELP|TYPE) \w+ .+|\w+(\{(\w+="([^"\\\n]|\\.)*",?)+\})? -?[\d.e+-]+)$')
    lines = exposition(REPORT).splitlines()
    assert [text for text in lines if not line.match(text)] == []
    names = [re.split(r"[{ ]", text)[0] for text in lines if not text.startswith("#")]
    blocks = [name for name, before in zip(names, [None, *names], strict=False) if name != before]
    assert len(blocks) == len(set(blocks))


def test_every_metric_has_a_help_and_a_type_that_fits_its_name() -> None:
    families = list(text_string_to_metric_families(exposition(REPORT)))
    assert len(families) > 20
    for family in families:
        assert family.documentation.endswith(".")
        total = all(each.name.endswith("_total") for each in family.samples)
        assert (family.type == "counter") == total or not family.samples


def test_one_state_is_1_and_numbers_keep_all_their_digits() -> None:
    metrics = read(exposition(REPORT))
    states = {state: value(metrics, "state", state=state.value) for state in ServiceState}
    assert states == {state: float(state is ServiceState.TRACKING) for state in ServiceState}
    assert value(metrics, "device_received_total", device=FRONT, what="received") == 123456789


def test_each_device_tells_its_state_flow_and_counters() -> None:
    metrics = read(exposition(REPORT))
    assert value(metrics, "device_up", device=FRONT, kind="camera") == 1.0
    assert value(metrics, "device_up", device=DVL, kind="link") == 0.0
    assert value(metrics, "device_state", device=DVL, kind="link", state="lost") == 1.0
    assert value(metrics, "device_up", device="recorder", kind="recorder") == 1.0
    assert value(metrics, "device_rate_hertz", device=FRONT) == 14.9
    assert value(metrics, "device_age_seconds", device=FRONT) == 0.05
    assert value(metrics, "device_lag_seconds", device=FRONT) == 0.036
    assert value(metrics, "device_rate_hertz", device=DVL) is None
    assert value(metrics, "device_reconnects_total", device=DVL) == 18.0
    assert value(metrics, "device_received_total", device=DVL, what="samples") == 12.0
    assert value(metrics, "device_not_asked_for_total", device=FRONT, what="overtaken") == 3.0
    assert value(metrics, "device_dropped_total", device=FRONT, what="lost") == 7.0
    assert value(metrics, "device_dropped_total", device=DVL, what="dropped_samples") == 17.0
    assert value(metrics, "device_errors_total", device=DVL, what="unheard") == 16.0


def test_stages_and_their_failures_are_told_apart_by_labels() -> None:
    metrics = read(exposition(REPORT))
    assert value(metrics, "stage_share", stage="track") == 0.4
    failure = {"stage": "pose", "error": "cv2.error", "place": 'a "b"'}
    assert value(metrics, "stage_failures_total", **failure) == 2.0
    assert value(metrics, "lag_seconds", quantile="0.95") == 0.12


def test_a_service_without_devices_is_read_too() -> None:
    metrics = read(exposition({**REPORT, "devices": {}}))
    assert value(metrics, "ok") == 1.0
