"""Every renderer against the float64 reference, forward and backward."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache

import pytest
import torch

from aquaflow.base.errors import AquaFlowError
from aquaflow.render import limits
from aquaflow.render.contract import Rendering
from aquaflow.render.cpu import CpuRenderer
from aquaflow.render.library import STAGES, load_library
from aquaflow.render.native import build as native
from aquaflow.render.reference import ReferenceRenderer
from tests.render.render_scenes import (
    HEIGHT,
    NAMES,
    RENDERERS,
    WIDTH,
    Scene,
    draw_and_differentiate,
    make,
    needs_compiler,
    random_scene,
    reference,
    relative_error,
)

TOLERANCE = 5e-5


def with_behind(scene: Scene) -> Scene:
    """A third of the Gaussians behind the camera, some across the near plane."""
    means = scene.means.clone()
    forward = scene.viewmat[2, :3]
    means[::3] -= forward * 4.5
    means[1::9] -= forward * (means[1::9] @ forward)[:, None]
    return replace(scene, means=means)


def with_tiny_and_huge(scene: Scene) -> Scene:
    scales = scene.scales.clone()
    scales[::4] = 1e-7
    scales[1::40] = 3.0
    return replace(scene, scales=scales)


SCENES = {
    "turned camera": random_scene(0),
    "another turned camera": random_scene(1, n=200),
    "three channels": random_scene(2, channels=3),
    "behind the camera": with_behind(random_scene(3)),
    "tiny and huge": with_tiny_and_huge(random_scene(4)),
    "opaque, many layers": replace(random_scene(5, n=400), opacities=torch.ones(400)),
}


@cache
def reference_of(name: str) -> tuple[Rendering, list[torch.Tensor]]:
    return reference(SCENES[name])


@pytest.mark.parametrize("kind", RENDERERS)
@pytest.mark.parametrize("name", SCENES)
def test_image_and_gradients_agree_with_the_float64_reference(kind: str, name: str) -> None:
    scene = SCENES[name]
    wanted, wanted_gradients = reference_of(name)
    got, gradients = draw_and_differentiate(make(kind), scene)
    assert (got.image - wanted.image).abs().max() < 3e-5
    assert (got.alpha - wanted.alpha).abs().max() < 3e-5
    assert torch.equal(got.visible, wanted.visible)
    assert torch.allclose(got.radius_px.double(), wanted.radius_px, rtol=1e-4)
    for key, gradient, expected in zip(NAMES, gradients, wanted_gradients, strict=True):
        assert relative_error(gradient, expected) < TOLERANCE, key


def test_reference_gradients_agree_with_finite_differences() -> None:
    scene = random_scene(8, n=4)

    def draw(*tensors: torch.Tensor) -> torch.Tensor:
        out = ReferenceRenderer()(*tensors, scene.K, 6, 5)
        return out.image.sum() + out.alpha.square().sum()

    K = scene.K * torch.tensor([[0.18], [0.18], [1.0]])
    scene = replace(scene, K=K, scales=scene.scales * 8)  # smooth: no pixel near a threshold
    assert torch.autograd.gradcheck(draw, scene.leaves(torch.float64)[:6], eps=1e-7, atol=1e-4)


@pytest.mark.parametrize("kind", RENDERERS)
def test_a_lone_gaussian_is_centred_where_the_pinhole_projects_it(kind: str) -> None:
    scene = Scene(
        torch.tensor([[0.0, 0.0, 2.0]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.full((1, 3), 0.05),
        torch.tensor([0.8]),
        torch.tensor([[1.0, 0.5, 0.25, 2.0]]),
        torch.eye(4),
        torch.tensor([[40.0, 0.0, 10.5], [0.0, 40.0, 8.5], [0.0, 0.0, 1.0]]),
    )
    out = make(kind)(*scene.leaves(), WIDTH, HEIGHT)
    assert out.alpha.argmax() == 8 * WIDTH + 10  # the pixel whose centre is (10.5, 8.5)
    assert out.alpha[8, 10].item() == pytest.approx(0.8, rel=1e-5)
    assert torch.allclose(out.image[8, 10], 0.8 * scene.colours[0], rtol=1e-5)
    assert out.radius_px.item() == pytest.approx(3 * (1.0 + 0.3) ** 0.5, rel=1e-5)


@pytest.mark.parametrize("kind", RENDERERS)
def test_an_empty_map_draws_black_and_takes_gradients(kind: str) -> None:
    scene = random_scene(0, n=0)
    out, gradients = draw_and_differentiate(make(kind), scene)
    assert out.image.shape == (HEIGHT, WIDTH, 4)
    assert not out.image.any()
    assert not out.alpha.any()
    assert all(not gradient.any() for gradient in gradients)


def degenerate_scene() -> tuple[Scene, torch.Tensor]:
    """Rows 0 to 19 each broken in their own way; returns also the rows that are sound."""
    scene = random_scene(6)
    leaves = [leaf.detach() for leaf in scene.leaves()]
    means, quats, scales, opacities, colours = leaves[:5]
    nan, inf = float("nan"), float("inf")
    quats[0], quats[1, 2], quats[2], quats[3] = 0, nan, 1e-20, inf
    scales[4, 0], scales[5], scales[6, 1], scales[7, 2], scales[8] = 0, inf, nan, -1, 1e30
    opacities[9], opacities[10], opacities[11], opacities[12] = 0, nan, -1, inf
    means[13, 0], means[14, 2], means[15] = nan, inf, -5 * scene.viewmat[2, :3]
    colours[16, 3], colours[17] = nan, inf
    means[18] = 3e38
    quats[19] = 1e30
    sound = torch.ones(len(means), dtype=torch.bool)
    sound[:20] = False
    return Scene(*leaves), sound


@pytest.mark.parametrize("kind", [*RENDERERS, "reference"])
def test_degenerate_gaussians_are_culled_with_zero_gradient(kind: str) -> None:
    scene, sound = degenerate_scene()
    rest = Scene(*(getattr(scene, name)[sound] for name in NAMES[:5]), scene.viewmat, scene.K)
    renderer = make(kind)
    dtype = torch.float64 if kind == "reference" else torch.float32
    out, gradients = draw_and_differentiate(renderer, scene, dtype)
    clean, clean_gradients = draw_and_differentiate(renderer, rest, dtype)
    broken = ~sound
    if kind == "reference":  # 1e30 is an ordinary length in float64
        broken[19] = False
        assert all(gradient.isfinite().all() for gradient in gradients)
    else:
        assert (out.image - clean.image).abs().max() < 1e-5
        for gradient, expected in zip(gradients[:5], clean_gradients[:5], strict=True):
            assert relative_error(gradient[sound], expected) < 1e-5
    assert not out.visible[broken].any()
    assert not any(gradient[broken].any() for gradient in gradients[:5])
    assert gradients[5].isfinite().all()


@pytest.mark.parametrize("kind", RENDERERS)
def test_opacity_one_draws_at_the_clamp_and_takes_no_gradient_there(kind: str) -> None:
    scene = random_scene(9, n=1)
    scene = replace(scene, opacities=torch.ones(1), scales=torch.full((1, 3), 5.0))
    out, gradients = draw_and_differentiate(make(kind), scene)
    assert out.alpha.max().item() == pytest.approx(limits.MAX_ALPHA, abs=1e-6)
    assert all(gradient.isfinite().all() for gradient in gradients)


@pytest.mark.parametrize("kind", RENDERERS)
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_camera_that_is_not_finite_draws_nothing(kind: str, bad: float) -> None:
    scene = random_scene(0)
    scene.viewmat[1, 1] = bad
    out, gradients = draw_and_differentiate(make(kind), scene)
    assert not out.image.any()
    assert not out.visible.any()
    assert not any(gradient.any() for gradient in gradients)


@pytest.mark.parametrize("kind", RENDERERS)
def test_the_same_inputs_give_the_same_bits(kind: str) -> None:
    scene = random_scene(10, n=2000)
    first, first_gradients = draw_and_differentiate(make(kind), scene)
    for _ in range(3):
        again, gradients = draw_and_differentiate(make(kind), scene)
        assert torch.equal(first.image, again.image)
        assert all(map(torch.equal, gradients, first_gradients))


@needs_compiler
@pytest.mark.parametrize("isa", native.supported_isas())
def test_the_image_does_not_depend_on_the_number_of_threads(isa: str) -> None:
    scene = random_scene(10, n=2000)
    one, gradients = draw_and_differentiate(CpuRenderer(1, isa), scene)
    for threads in (2, 3, 7):
        more, others = draw_and_differentiate(CpuRenderer(threads, isa), scene)
        assert torch.equal(one.image, more.image)
        assert torch.equal(one.alpha, more.alpha)
        for a, b in zip(gradients, others, strict=True):
            assert relative_error(a, b) < 1e-5


@pytest.mark.parametrize("kind", RENDERERS)
def test_backward_passes_may_run_in_any_order(kind: str) -> None:
    renderer = make(kind)
    a, b = random_scene(11), random_scene(12, n=77, channels=3)
    _, wanted_a = draw_and_differentiate(renderer, a)
    _, wanted_b = draw_and_differentiate(renderer, b)
    leaves_a, leaves_b = a.leaves(), b.leaves()
    drawn_a = renderer(*leaves_a, WIDTH, HEIGHT)
    drawn_b = renderer(*leaves_b, WIDTH, HEIGHT)
    for drawn in (drawn_a, drawn_b):
        rng = torch.Generator().manual_seed(7)
        g_image = torch.randn(drawn.image.shape, generator=rng)
        g_alpha = torch.randn(drawn.alpha.shape, generator=rng)
        ((drawn.image * g_image).sum() + (drawn.alpha * g_alpha).sum()).backward()
    for leaves, wanted in ((leaves_a, wanted_a), (leaves_b, wanted_b)):
        assert all(torch.equal(leaf.grad, g) for leaf, g in zip(leaves[:6], wanted, strict=True))


@needs_compiler
def test_contexts_return_to_the_pool_when_their_graph_is_gone() -> None:
    renderer = CpuRenderer(1)
    for _ in range(5):
        draw_and_differentiate(renderer, random_scene(0))
        with torch.no_grad():
            renderer(*random_scene(1).leaves(), WIDTH, HEIGHT)
    assert len(renderer._pool.idle) == 1


@needs_compiler
@pytest.mark.parametrize("isa", native.supported_isas())
def test_stage_times_are_those_of_the_last_pass_and_fit_into_it(isa: str) -> None:
    renderer = CpuRenderer(1, isa)
    assert renderer.stage_ms() == dict.fromkeys(STAGES, 0.0)
    begin = time.perf_counter()
    draw_and_differentiate(renderer, random_scene(0, n=2000))
    passed_ms = 1e3 * (time.perf_counter() - begin)
    both = renderer.stage_ms()
    assert all(0 < both[stage] < passed_ms for stage in STAGES)
    assert sum(both.values()) < passed_ms
    with torch.no_grad():
        renderer(*random_scene(1).leaves(), WIDTH, HEIGHT)
    forward = renderer.stage_ms()
    assert list(forward) == list(STAGES)
    assert [stage for stage in STAGES if forward[stage] == 0] == list(STAGES[3:])


@needs_compiler
def test_stages_that_did_not_run_took_no_time() -> None:
    renderer = CpuRenderer(1)
    draw_and_differentiate(renderer, random_scene(0))
    draw_and_differentiate(renderer, random_scene(0, n=0))  # backward has nothing to do
    assert not any(renderer.stage_ms()[stage] for stage in STAGES[3:])


@needs_compiler
def test_loading_the_library_keeps_denormal_numbers() -> None:
    for isa in native.supported_isas():
        draw_and_differentiate(CpuRenderer(2, isa), random_scene(0, n=10))
    assert (torch.tensor([1.5e-40]) * 1.0).item() > 0


@needs_compiler
@pytest.mark.parametrize("isa", native.supported_isas())
def test_native_constants_mirror_the_contract(isa: str) -> None:
    wanted = [
        limits.DILATION_PX2,
        limits.MAX_ALPHA,
        limits.MIN_ALPHA,
        limits.MIN_TRANSMITTANCE,
        limits.NEAR_PLANE_M,
        limits.TANGENT_MARGIN,
        limits.MIN_QUAT_NORM_SQ,
        limits.MAX_SIGMA_PX,
        limits.RADIUS_SIGMAS,
        limits.TILE_PX,
    ]
    assert load_library(isa).constants() == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("kind", RENDERERS)
def test_a_wrong_shape_is_named(kind: str) -> None:
    leaves = random_scene(0).leaves()
    leaves[2] = leaves[2][:, :2]
    with pytest.raises(AquaFlowError, match="scales"):
        make(kind)(*leaves, WIDTH, HEIGHT)
