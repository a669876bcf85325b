"""Ranges of known surfaces, fused to triangles: planes, spheres, holes and haze."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.geometry.camera import CameraModel
from aquaflow.render.library import library_or_none
from aquaflow.survey.export.mesh import blocks as blocks_module
from aquaflow.survey.export.mesh import seen_places
from aquaflow.survey.export.mesh.atlas import lay_out, paint
from aquaflow.survey.export.mesh.blocks import BLOCK, CHUNK_BLOCKS, STRIDE_PX, Blocks
from aquaflow.survey.export.mesh.seen_places import ColourSums, RaySums, look_at, place_sigmas
from aquaflow.survey.export.mesh.surface import DistanceSums, add_by_numpy, add_compiled
from aquaflow.survey.export.mesh.triangle_mesh import TriangleMesh
from aquaflow.survey.export.mesh.view_surfaces import surface_normals, truncation, unit_rays
from tests.survey.export.mesh_scenes import (
    FAR_CAMERA,
    RADIUS,
    SIGMA,
    VOXEL,
    Array,
    above_plane,
    around_sphere,
    fused_mesh,
    plane_with_hole,
    surfaces_of,
    to_plane,
    to_sphere,
)

pytest.importorskip("skimage", reason="scikit-image is not installed")
trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> TriangleMesh:
    poses = around_sphere()
    work = tmp_path_factory.mktemp("sphere")
    return fused_mesh(surfaces_of(poses, [to_sphere] * len(poses), work, FAR_CAMERA))


def read(mesh: TriangleMesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def test_a_sphere_is_closed_across_chunks_and_as_large_as_it_is(sphere: TriangleMesh) -> None:
    # 2 / 0.03 voxels: eight chunks at least.
    assert np.ptp(np.floor(sphere.vertices / (64 * VOXEL)), axis=0).min() >= 1.0
    found = read(sphere)
    assert found.is_watertight
    assert found.is_winding_consistent
    assert found.euler_number == 2
    error = np.linalg.norm(sphere.vertices, axis=1) - RADIUS
    assert np.sqrt(np.mean(error**2)) < 0.05 * VOXEL
    assert np.abs(error).max() < 0.5 * VOXEL
    assert found.volume == pytest.approx(4.0 / 3.0 * np.pi * RADIUS**3, rel=0.01)
    assert sphere.area() == pytest.approx(found.area)


def test_normals_point_to_where_the_cameras_are(sphere: TriangleMesh) -> None:
    outward = sphere.vertices / np.linalg.norm(sphere.vertices, axis=1, keepdims=True)
    cosine = (sphere.normals() * outward).sum(axis=1)
    assert cosine.min() > 0.9
    assert cosine.mean() > 0.999


def test_a_plane_is_flat_and_a_hole_in_it_stays_a_hole(tmp_path: Path) -> None:
    poses = above_plane()
    whole = fused_mesh(surfaces_of(poses, [to_plane] * 5, tmp_path))
    holed = fused_mesh(surfaces_of(poses, [plane_with_hole] * 5, tmp_path))
    for mesh in (whole, holed):
        assert np.abs(mesh.vertices[:, 2]).max() < 0.02 * VOXEL
        assert (mesh.normals()[:, 2] > 0.999).all()
    near = np.hypot(*whole.vertices[:, :2].T) < 0.2
    assert near.sum() > 100
    assert not (np.hypot(*holed.vertices[:, :2].T) < 0.2).any()
    assert read(whole).euler_number == 1
    assert read(holed).euler_number == 0


def test_haze_that_one_view_has_before_the_ground_is_taken_away(tmp_path: Path) -> None:
    def hazy(centre: Array, rays: Array) -> Array:
        ranges = to_plane(centre, rays)
        ranges[40:50, 50:70] *= 0.6
        return ranges

    mesh = fused_mesh(surfaces_of(above_plane(), [hazy, *[to_plane] * 4], tmp_path))
    assert np.abs(mesh.vertices[:, 2]).max() < 0.1 * VOXEL
    shown_by_one = fused_mesh(surfaces_of(above_plane()[:1], [hazy], tmp_path), least_views=1)
    assert shown_by_one.vertices[:, 2].max() > 0.5


def test_what_one_view_alone_shows_is_a_hole(tmp_path: Path) -> None:
    surfaces = surfaces_of(above_plane()[:1], [to_plane], tmp_path)
    assert not len(fused_mesh(surfaces).faces)
    assert len(fused_mesh(surfaces, least_views=1).faces) > 1000


def test_errors_of_single_views_are_averaged(tmp_path: Path) -> None:
    random = np.random.default_rng(5)

    def noisy(centre: Array, rays: Array) -> Array:
        smooth = to_plane(centre, rays)
        return smooth + random.normal(0.0, SIGMA, smooth.shape)

    mesh = fused_mesh(surfaces_of(above_plane(), [noisy] * 5, tmp_path))
    inner = (np.abs(mesh.vertices[:, :2]) < 0.4).all(axis=1)
    assert 0.0 < np.sqrt(np.mean(mesh.vertices[inner, 2] ** 2)) < 0.75 * SIGMA


def test_the_truncation_follows_the_sigma_between_three_and_six_voxels() -> None:
    sigmas = np.array([0.0, 1.5, 9.0])
    np.testing.assert_allclose(truncation(sigmas, 1.0), [3.0, 4.5, 6.0])


def test_small_pieces_go_and_large_ones_stay() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    both = TriangleMesh(np.vstack([square, 0.1 * square + 5.0]), np.vstack([faces, faces + 4]))
    left, kept = both.without_small_pieces(0.5)
    np.testing.assert_array_equal(kept, [0, 1, 2, 3])
    np.testing.assert_array_equal(left.vertices, square)
    np.testing.assert_array_equal(left.faces, faces)
    assert len(both.without_small_pieces(0.001)[0].faces) == 4
    assert not len(both.without_small_pieces(2.0)[0].faces)


def test_the_sigma_of_a_place_is_what_rays_of_one_pixel_leave_open(tmp_path: Path) -> None:
    poses = above_plane()
    surfaces = surfaces_of(poses, [to_plane] * 5, tmp_path)
    places = np.array([[0.0, 0.1, 0.0], [9.0, 9.0, 0.0]])
    sigma, sigma_px = place_sigmas(surfaces, places, VOXEL, None)
    # Five rays within 0.3 of each other from 2 above: a pixel is 0.02, the height worse.
    assert 0.02 < sigma[0] < 0.12
    assert sigma_px[0] == pytest.approx(sigma[0] / 0.02, rel=0.1)
    assert np.isinf([sigma[1], sigma_px[1]]).all()
    seen = look_at(surfaces, places, VOXEL, None)
    assert np.isinf(seen.nearest[1])
    np.testing.assert_allclose(seen.radiance[0], [0.5, 0.6, 0.5], atol=0.02)
    alone = surfaces_of(poses[:1], [to_plane], tmp_path)
    assert place_sigmas(alone, np.zeros((1, 3)), VOXEL, None)[0] > 1e3
    assert np.isfinite(look_at(alone, np.zeros((1, 3)), VOXEL, None).nearest[0])


def test_compiled_fusion_finds_what_numpy_finds(tmp_path: Path) -> None:
    library = library_or_none()
    if library is None:
        pytest.skip("no compiled kernels here")
    surfaces = surfaces_of(above_plane(), [plane_with_hole, *[to_plane] * 4], tmp_path)
    places = np.random.default_rng(0).uniform((-2.0, -2.0, -0.2), (2.0, 2.0, 2.5), (20000, 3))
    places[:2] = np.array([[np.nan], [np.inf]])
    places[2:7] = [view.T_uc.t for view in surfaces.views]
    expected, found = DistanceSums.of(places), DistanceSums.of(places)
    for number in range(5):
        with np.errstate(invalid="ignore"):
            add_by_numpy(expected, surfaces, number, VOXEL)
        add_compiled(library, found, surfaces, number, VOXEL)
    assert expected.near.max() == 5
    assert (expected.near == 0).sum() > 1000
    np.testing.assert_array_equal(found.near, expected.near)
    np.testing.assert_allclose(found.weights, expected.weights, rtol=1e-12)
    np.testing.assert_allclose(found.total, expected.total, rtol=1e-9, atol=1e-6)


def test_compiled_colours_and_information_are_those_of_numpy(tmp_path: Path) -> None:
    library = library_or_none()
    if library is None:
        pytest.skip("no compiled kernels here")
    surfaces = surfaces_of(above_plane(), [plane_with_hole, *[to_plane] * 4], tmp_path)
    places = np.random.default_rng(0).uniform((-2.0, -2.0, -0.3), (2.0, 2.0, 0.3), (20000, 3))
    places[:2] = np.array([[np.nan], [np.inf]])
    places[2:7] = [view.T_uc.t for view in surfaces.views]
    for kind in (ColourSums, RaySums):
        expected, found = kind.of(places), kind.of(places)
        for number in range(5):
            with np.errstate(invalid="ignore", divide="ignore"):
                expected.add_by_numpy(surfaces, number, VOXEL)
            found.add_compiled(library, surfaces, number, VOXEL)
        for name, values in vars(expected).items():
            np.testing.assert_allclose(getattr(found, name), values, rtol=1e-9, atol=1e-9)
        seen = np.isfinite(vars(expected)["nearest" if kind is ColourSums else "footprint"])
        assert 1000 < seen.sum() < 19000


def test_halves_of_any_size_are_read(tmp_path: Path) -> None:
    library = library_or_none()
    if library is None:
        pytest.skip("no compiled kernels here")
    surfaces = surfaces_of(above_plane()[:1], [to_plane], tmp_path)
    every = np.array([0.0, 2.0**-24, -(2.0**-15), 6.1e-5, 0.1, -1.0, 65504.0], np.float16)
    radiance = surfaces.radiance(0)
    radiance[:] = every[np.arange(radiance.size) % len(every)].reshape(radiance.shape)
    places = np.random.default_rng(1).uniform((-0.5, -0.5, 0.0), (0.5, 0.5, 0.0), (500, 3))
    expected, found = (look_at(surfaces, places, VOXEL, each) for each in (None, library))
    np.testing.assert_allclose(found.radiance, expected.radiance, rtol=1e-9)
    assert set(every.astype(float)) <= set(np.round(expected.radiance.ravel(), 30))


@pytest.mark.parametrize("stride", [2, 4, 5])
def test_normals_of_some_pixels_are_those_of_all(stride: int) -> None:
    ranges = np.random.default_rng(2).uniform(1.0, 1.1, (38, 51))
    ranges[9:12, 20] = np.nan
    camera = CameraModel(51, 38, 40.0, 40.0, 25.0, 19.0)
    every = surface_normals(unit_rays(camera), ranges)
    some = surface_normals(unit_rays(camera), ranges, stride)
    np.testing.assert_array_equal(some, every[::stride, ::stride])


def test_a_chunk_has_its_blocks_and_those_in_the_layer_after_it(tmp_path: Path) -> None:
    poses = around_sphere()
    surfaces = surfaces_of(poses, [to_sphere] * len(poses), tmp_path, FAR_CAMERA)
    blocks = Blocks(surfaces, VOXEL)
    chunks, side = list(blocks.chunks()), CHUNK_BLOCKS * BLOCK
    assert len(chunks) == blocks.chunk_count() >= 8
    every = np.unique(np.concatenate([chunk.blocks for chunk in chunks]), axis=0)
    assert len(every) == len(blocks)
    for chunk in chunks:
        near = ((every >= chunk.corner) & (every <= chunk.corner + side)).all(axis=1)
        np.testing.assert_array_equal(chunk.blocks, every[near])


def test_blocks_are_those_that_hold_a_place_or_lie_within_a_voxel_of_it(tmp_path: Path) -> None:
    poses = around_sphere()[:3]
    surfaces = surfaces_of(poses, [to_sphere] * len(poses), tmp_path, FAR_CAMERA)
    found = {
        tuple(block)
        for chunk in Blocks(surfaces, VOXEL).chunks()
        for block in (chunk.blocks // BLOCK).tolist()
    }
    expected = set()
    for number in range(len(surfaces.views)):
        points, normals, sigmas = surfaces.points(number, STRIDE_PX)
        for side in (-1.0, 0.0, 1.0):
            reach = side * truncation(sigmas, VOXEL)[:, None] * normals
            for away in itertools.product((-1.0, 1.0), repeat=3):
                places = (points + reach) / VOXEL + away
                expected |= set(map(tuple, np.floor(places / BLOCK).astype(int).tolist()))
    assert found == expected


def test_the_area_that_is_shown_is_known_to_a_factor_of_two(tmp_path: Path) -> None:
    poses = around_sphere()
    surfaces = surfaces_of(poses, [to_sphere] * len(poses), tmp_path, FAR_CAMERA)
    assert 0.5 < surfaces.area / (4.0 * np.pi * RADIUS**2) < 2.0


def test_too_many_voxels_are_refused_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    surfaces = surfaces_of(above_plane(), [to_plane] * 5, tmp_path)
    monkeypatch.setattr(blocks_module, "MOST_BLOCKS", 20)
    with pytest.raises(InputError, match="give a larger --resolution"):
        Blocks(surfaces, VOXEL)
    with pytest.raises(InputError, match="too small for a dive of this extent"):
        Blocks(surfaces, 1e-8)


def test_a_texture_has_the_colours_of_its_places_up_to_its_seams(
    sphere: TriangleMesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("xatlas", reason="xatlas is not installed")
    monkeypatch.setattr(seen_places, "BATCH", 1000)

    def colour(places: Array):  # type: ignore[no-untyped-def]  # as in atlas.Colour
        return np.clip(127.0 * (places + 1.0), 0, 255).astype(np.uint8), places[:, 2] < 0.99

    layout = lay_out(sphere, VOXEL)
    picture = paint(sphere, layout, colour)
    assert picture.shape == (layout.height, layout.width, 3)
    np.testing.assert_array_equal(layout.source[layout.faces], sphere.faces)
    corners = layout.places[layout.faces].mean(axis=1).astype(int)
    found = picture[corners[:, 1], corners[:, 0]]
    expected, _ = colour(sphere.vertices[sphere.faces].mean(axis=1))
    error = np.abs(found.astype(float) - expected)
    assert error.mean() < 2.0
    assert error.max() < 20.0  # in the cap without a colour, 0.15 across


def test_a_texture_that_would_be_too_large_is_coarser(
    sphere: TriangleMesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("xatlas", reason="xatlas is not installed")
    monkeypatch.setattr("aquaflow.survey.export.mesh.atlas.LARGEST_SIDE", 1024)
    layout = lay_out(sphere, 0.0001)
    assert 512 < max(layout.width, layout.height) <= 1024
