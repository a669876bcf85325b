"""What ``lab bench render`` measures: work counted, times, rates, peak, loss, optimiser."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from aquaflow.lab.bench.render import peak as peaks
from aquaflow.lab.bench.render.contenders import (
    COVERING,
    BlendLimit,
    Timed,
    covering_scene,
    measure_blend_limit,
)
from aquaflow.lab.bench.render.interactions import count_interactions
from aquaflow.lab.bench.render.parts import parts_of, time_parts
from aquaflow.lab.bench.render.rows import row_of
from aquaflow.lab.bench.render.timing import Sample, interleave, time_renderer
from aquaflow.render.example_scene import Size, height_field
from aquaflow.render.limits import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from aquaflow.render.native.build import supported_isas
from aquaflow.render.reference import ReferenceRenderer, project
from tests.lab.bench.render.pretended_renderer import PEAK, TINY, Pretended, SlowedClock


def brute_force_interactions(size: Size) -> int:
    """Pixel by pixel, Gaussian by Gaussian, front to back."""
    scene = height_field(size)
    means, quats, scales, opacities, colours, viewmat = (t.double() for t in scene.inputs)
    K = scene.K.double()
    seen = project(means, quats, scales, opacities, colours, viewmat, K, size.width, size.height)
    y, x = torch.meshgrid(
        torch.arange(size.height) + 0.5, torch.arange(size.width) + 0.5, indexing="ij"
    )
    transmittance = torch.ones(size.height, size.width, dtype=torch.float64)
    count = 0
    for centre, conic, opacity in zip(seen.centre, seen.conic, seen.opacity, strict=True):
        dx, dy = x - centre[0], y - centre[1]
        power = conic[0] * dx * dx + 2 * conic[1] * dx * dy + conic[2] * dy * dy
        alpha = (opacity * torch.exp(-0.5 * power)).clamp(max=MAX_ALPHA)
        blended = (alpha > MIN_ALPHA) & (transmittance > MIN_TRANSMITTANCE)
        count += int(blended.sum())
        transmittance = torch.where(alpha > MIN_ALPHA, transmittance * (1 - alpha), transmittance)
    return count


@pytest.mark.parametrize("size", [TINY, Size(3_000, 52, 39)], ids=["thin", "opaque"])
def test_interactions_are_those_that_a_pixel_by_pixel_count_finds(size: Size) -> None:
    assert count_interactions(height_field(size)) == brute_force_interactions(size)


def test_the_scene_is_seeded_in_view_and_as_wide_as_said() -> None:
    scene, again = height_field(TINY), height_field(TINY)
    for first, second in zip(scene.inputs, again.inputs, strict=True):
        assert torch.equal(first, second)
    assert not torch.equal(scene.inputs[0], height_field(TINY, seed=1).inputs[0])
    drawn = scene.drawn_by(ReferenceRenderer(), scene.inputs)
    assert drawn.visible.all()
    means, _, scales, _, _, viewmat = scene.inputs
    depth = (means @ viewmat[:3, :3].T + viewmat[:3, 3])[:, 2]
    assert 0.9 < depth.min() < 1.5
    assert 4.5 < depth.max() < 5.5
    sigma_px = scales * (scene.K[0, 0] / depth)[:, None]
    assert 1.99 < sigma_px.min() < 2.1
    assert 3.9 < sigma_px.max() < 4.01


@pytest.mark.parametrize(("threads", "cpu"), [(1, (5.0, 15.0)), (2, (None, None))])
def test_forward_and_backward_are_timed_apart(
    threads: int, cpu: tuple[float | None, float | None]
) -> None:
    time = SlowedClock()
    sample = time_renderer(Pretended(time, threads), height_field(TINY), clock=time.clock())
    assert (sample.fwd_ms, sample.bwd_ms) == pytest.approx((10.0, 30.0))
    assert (sample.fwd_cpu_ms, sample.bwd_cpu_ms) == (
        pytest.approx(cpu) if cpu[0] is not None else cpu
    )
    assert sample.stage_ms == {"project": 1.0, "blend": 9.0}


def test_a_renderer_that_tells_no_stages_has_none() -> None:
    assert time_renderer(ReferenceRenderer(), height_field(TINY)).stage_ms == {}


def test_repeats_are_interleaved_and_start_with_another_job_each() -> None:
    order: list[int] = []
    jobs = [lambda k=k: (order.append(k), k)[1] for k in range(3)]
    assert interleave(jobs, 2) == [[0, 0], [1, 1], [2, 2]]
    assert order == [0, 1, 2, 1, 2, 0]
    assert interleave(jobs[:0], 2) == []


def test_a_row_has_medians_rates_and_shares_of_the_peak() -> None:
    one, two = (Timed(Pretended(SlowedClock(), threads)) for threads in (1, 2))
    samples = [Sample(f, 40.0, 5.0, 20.0, {"blend": f}) for f in (10.0, 90.0, 20.0)]
    row = row_of(one, TINY, samples, 100_000, PEAK, 0.5)
    assert (row["fwd_ms"], row["fwd_ms_half_range"], row["repeats"]) == (20.0, 40.0, 3)
    assert row["fwd_interactions_per_s"] == pytest.approx(20e6)  # of the CPU time
    assert row["share_of_peak"]["fwd"] == pytest.approx(0.6)  # 30 operations each
    assert row["share_of_peak"]["bwd"] == pytest.approx(0.28)  # 56 operations each
    assert row["share_of_peak"]["both"] == pytest.approx(0.344)
    assert row["stage_ms"] == {"blend": 20.0}
    row = row_of(two, TINY, [Sample(10.0, 40.0)], 100_000, PEAK, None)
    assert row["fwd_cpu_ms"] is None
    assert row["fwd_interactions_per_s"] == pytest.approx(10e6)  # of the wall's
    assert row["share_of_peak"]["fwd"] == pytest.approx(0.15)
    assert row["stage_ms"] is None


def test_a_row_of_the_kernels_has_its_share_of_what_blending_does_at_most() -> None:
    limited = replace(PEAK, blending={"avx2": BlendLimit(40e6, 20e6)})
    samples = [Sample(9.0, 40.0, 5.0, 20.0)]
    for name, threads, shares in (
        ("cpu", 1, {"fwd": 0.5, "bwd": 0.25, "both": 0.3}),
        ("cpu", 2, {"fwd": 0.25, "bwd": 0.125, "both": 0.15}),
        ("tiles", 1, None),
    ):
        kernel = SimpleNamespace(name=name, isa="avx2", threads=threads)
        row = row_of(kernel, TINY, samples, 100_000, limited, None)  # type: ignore[arg-type]
        share = row["share_of_blend_limit"]
        assert share == (None if shares is None else pytest.approx(shares))


def test_gaussians_of_the_limits_scene_reach_every_pixel_and_saturate_none() -> None:
    scene = covering_scene()
    assert count_interactions(scene) == COVERING.n * COVERING.pixels
    found = measure_blend_limit(supported_isas()[0])
    assert found.seconds(round(found.fwd))["fwd"] == pytest.approx(1.0)
    assert min(found.fwd, found.bwd) > 0.0


def test_the_peak_is_measured_with_and_without_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peaks, "STEPS", 20_000)
    monkeypatch.setattr(peaks, "MATRIX", 64)
    threads = torch.get_num_threads()
    compiled = peaks.measure_peak((1, 2))
    assert "multiply-add loop" in compiled.method
    assert compiled.flop_per_s.keys() == {1, 2}
    assert min(compiled.flop_per_s.values()) > 1e8
    monkeypatch.setattr(peaks.build, "find_compiler", lambda: None)
    assert "64 x 64 matrices" in peaks.measure_peak((1,)).method
    assert torch.get_num_threads() == threads


def test_loss_and_optimiser_are_timed_with_every_number_of_threads() -> None:
    ticks: list[int] = []
    rows = time_parts(parts_of((1, 2), [(32, 24)], [50]), 2, lambda: ticks.append(1))
    assert len(ticks) == 2 * len(rows)
    assert {(row["part"], row["variant"]) for row in rows} == {
        ("L1 + SSIM", "fused"), ("Adam", "torch, fused"),
        ("Adam", "selective, 100% seen"), ("Adam", "selective, 30% seen"),
    }  # fmt: skip
    assert all(row["ms"] > 0.0 for row in rows)
    assert all((row["cpu_ms"] is None) == (row["threads"] == 2) for row in rows)
