"""The synthetic dive: what is written is deterministic, physical and consistent with itself."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import torch
from pydantic import ValidationError
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import InputError
from aquaflow.geometry.optics import rays_of_pixels
from aquaflow.geometry.port import FlatPort
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import build, write_dive
from aquaflow.lab.synthetic.path import Path as Way
from aquaflow.lab.synthetic.render import SyntheticScene
from aquaflow.lab.synthetic.telemetry import read_telemetry
from aquaflow.lab.synthetic.truth import Truth, read_truth
from aquaflow.lab.synthetic.water import WATER_TYPES

SMALL = SyntheticConfig(frames=10, width=160, height=120)
SHORT = SyntheticConfig(frames=2, width=64, height=48)
BARE = {"supersampling": 1, "snow_per_m3": 0.0, "vignette": 0.0, "noise_sigma": 0.0}


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dive")
    write_dive(out, SMALL, None)
    return out


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """SHORT as it was written first."""
    out = tmp_path_factory.mktemp("once")
    write_dive(out, SHORT, None)
    return out


@cache
def built() -> tuple[SyntheticScene, Way]:
    """The scene and the path of SMALL."""
    return build(SMALL)


@pytest.fixture(scope="module")
def long_path(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    """The default loop of 90 frames, in pictures small enough to be quick."""
    out = tmp_path_factory.mktemp("loop")
    write_dive(out, SyntheticConfig(width=64, height=48, supersampling=1), None)
    return read_truth(out)


def _seen_from(
    truth: Truth, i: int, j: int
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Where frame i's points fall in frame j: pixels, ranges, and whether inside the picture."""
    R, t = truth.T_wc[j, :3, :3], truth.T_wc[j, :3, 3]
    points = truth.points_w(i).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    local = (points - t) @ R
    pixels = truth.camera.project(local)
    size = np.array([truth.camera.width, truth.camera.height])
    inside = (local[:, 2] > 0.1) & ((pixels > 1.0) & (pixels < size - 1.0)).all(axis=1)
    return pixels, np.linalg.norm(local, axis=1), inside


def test_the_same_seed_twice_gives_the_same_bytes(once: Path, tmp_path: Path) -> None:
    write_dive(tmp_path, SHORT, None)
    names = sorted(p.relative_to(once) for p in once.rglob("*") if p.is_file())
    assert len(names) == 3 * SHORT.frames + 7
    for name in names:
        assert (once / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_another_seed_gives_another_dive(once: Path, tmp_path: Path) -> None:
    write_dive(tmp_path, SHORT.model_copy(update={"seed": 1}), None)
    assert (once / "images/000000.png").read_bytes() != (
        tmp_path / "images/000000.png"
    ).read_bytes()


@pytest.mark.parametrize(
    "scene", ["reef", "flat_sand", "wall", "pipe", "pool", "survey", "hull", "net"]
)
def test_picture_is_clean_radiance_through_the_stated_water(scene: str, tmp_path: Path) -> None:
    # Of a net only a picture whose pixels are no wider than its twine has one range in each.
    size = {"width": 480, "height": 360} if scene == "net" else {"width": 64, "height": 48}
    config = SyntheticConfig.model_validate({"frames": 2, **size, "scene": scene, **BARE})
    write_dive(tmp_path, config, None)
    truth = read_truth(tmp_path)
    expected = truth.medium.compose(truth.clean(0), truth.range_m(0))
    # Half a grey level for each of the two quantisations.
    assert np.abs(expected - truth.image(0)).max() < 1.01 / 255.0


def test_ranges_of_two_frames_agree_on_the_same_points(small: Path) -> None:
    truth = read_truth(small)
    pixels, ranges, inside = _seen_from(truth, 3, 8)
    assert inside.mean() > 0.4
    at = pixels[inside] - 0.5
    there = map_coordinates(truth.range_m(8).astype(float), [at[:, 1], at[:, 0]], order=1)
    error = np.abs(there - ranges[inside]) / ranges[inside]
    assert np.median(error) < 0.005


def test_ranges_lie_on_the_surface_to_one_in_ten_thousand() -> None:
    scene, _ = built()
    generator = torch.Generator().manual_seed(0)
    down = torch.nn.functional.normalize(
        torch.rand(3, 2000, generator=generator) * torch.tensor([[1.0], [1.0], [-1.0]]), dim=0
    )
    origin = torch.tensor([0.3, 0.1, scene.field.top + 1.0])
    t = scene.field.hit(origin, down, torch.zeros(2000), 1e-3, 14.0)
    hit = t.isfinite()
    assert hit.float().mean() > 0.8

    def gap(at: torch.Tensor) -> torch.Tensor:
        x, y, z = (origin[k] + at * down[k, hit] for k in range(3))
        return z - scene.field.height(x, y)

    # Above the surface just before the range, below it just after.
    found = (gap(t[hit] * (1.0 - 1e-4)) > 0.0) & (gap(t[hit] * (1.0 + 1e-4)) < 0.0)
    assert float(found.float().mean()) > 0.995
    fine = torch.linspace(0.0, 1.0, 600)[:, None] * (t[hit] - 2e-3)
    x, y, z = (origin[k] + fine * down[k, hit] for k in range(3))
    above = z.reshape(-1) - scene.field.height(x.reshape(-1), y.reshape(-1))
    assert float((above < -2e-3).float().mean()) < 1e-4, "a ray went through the surface"


def test_a_picture_spans_ranges_of_one_to_three_and_points_are_seen_near_and_far(
    long_path: Truth,
) -> None:
    spans = []
    for k in range(0, len(long_path), 10):
        ranges = long_path.range_m(k)
        spans.append(ranges.max() / ranges.min())
    assert np.median(spans) >= 3.0
    points = np.vstack([long_path.points_w(k).reshape(-1, 3) for k in range(0, 90, 15)])
    nearest, farthest = np.full(len(points), np.inf), np.zeros(len(points))
    for k in range(len(long_path)):
        R, t = long_path.T_wc[k, :3, :3], long_path.T_wc[k, :3, 3]
        local = (points - t) @ R
        pixels = long_path.camera.project(local)
        seen = (local[:, 2] > 0) & ((pixels > 0) & (pixels < (64, 48))).all(axis=1)
        distance = np.linalg.norm(local, axis=1)
        nearest = np.where(seen, np.minimum(nearest, distance), nearest)
        farthest = np.where(seen, np.maximum(farthest, distance), farthest)
    # A loop of 90 frames at less than 6 % of the width per frame cannot reach 3 for one point.
    assert np.quantile(farthest / nearest, 0.95) >= 2.4


def test_default_loop_closes_and_looks_at_the_same_place(long_path: Truth) -> None:
    first, last = long_path.T_wc[0], long_path.T_wc[-1]
    assert np.linalg.norm(last[:3, 3] - first[:3, 3]) < 0.15
    assert np.degrees(Rotation.from_matrix(first[:3, :3].T @ last[:3, :3]).magnitude()) < 3.0
    assert np.linalg.norm(long_path.T_wc[:, :3, 3] - first[:3, 3], axis=1).max() > 2.0
    assert _seen_from(long_path, len(long_path) - 1, 0)[2].mean() > 0.8


def test_motion_between_frames_stays_below_six_percent_of_the_width(long_path: Truth) -> None:
    centres = long_path.camera.pixel_centres().reshape(-1, 2)
    for k in range(0, len(long_path) - 1, 8):
        pixels, _, inside = _seen_from(long_path, k, k + 1)
        motion = np.linalg.norm(pixels - centres, axis=1)[inside]
        assert np.quantile(motion, 0.99) < 0.06 * long_path.camera.width
        assert np.median(motion) > 0.005 * long_path.camera.width


def test_default_reef_shows_no_open_water(long_path: Truth) -> None:
    assert all(np.isfinite(long_path.range_m(k)).all() for k in range(0, len(long_path), 10))


def test_a_slow_pan_changes_pixels_smoothly() -> None:
    from aquaflow.lab.synthetic.dive import camera_of
    from aquaflow.lab.synthetic.render import render
    from aquaflow.lab.synthetic.water import WATER_TYPES

    config = SMALL.model_copy(update={"width": 96, "height": 72})
    scene, path = build(config)
    camera, t = camera_of(config), np.array([0.5])
    R, centre = (path.R_ws.T @ path.R_wc(t))[0], path.centre_s(t)[0]
    quarter = 0.25 / camera.fx
    views = []
    for k in range(5):
        turn = Rotation.from_rotvec([0.0, k * quarter, 0.0]).as_matrix()
        views.append(render(scene, camera, R @ turn, centre, WATER_TYPES["clear"], 2).clean)
    steps = [np.abs(b - a).mean() for a, b in pairwise(views)]
    whole = np.abs(views[4] - views[0]).mean()
    # An aliased picture changes as much in a quarter of a pixel as in a whole one.
    assert max(steps) < 0.45 * whole
    assert max(steps) < 1.5 * min(steps)


def test_camera_poses_follow_from_body_attitude_and_mounting(small: Path) -> None:
    truth, path = read_truth(small), built()[1]
    np.testing.assert_allclose(
        truth.T_wc[:, :3, :3], path.R_wb(truth.timestamps_s) @ truth.R_bc, atol=1e-9
    )


def test_config_refuses_unknown_keys() -> None:
    with pytest.raises(ValidationError, match="colour"):
        SyntheticConfig.model_validate({"colour": "blue"})
    with pytest.raises(ValidationError, match="depth_khz"):
        SyntheticConfig.model_validate({"telemetry": {"depth_khz": 1}})


def test_damaged_dives_are_refused_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a complete synthetic dive"):
        read_truth(tmp_path)
    bad = tmp_path / "telemetry.csv"
    bad.write_text("t_s,arrival_s,kind,source,v0,v1,v2,v3\n0,0,depth,x,deep,,,\n")
    with pytest.raises(InputError, match="no telemetry sample"):
        list(read_telemetry(bad))


FLAT_PORT = {"kind": "flat", "distance_m": 0.05, "thickness_m": 0.01}
DOME = {"kind": "dome", "radius_m": 0.05, "thickness_m": 0.004, "centre_m": [0.003, -0.002, -0.01]}


@pytest.mark.parametrize(
    "changes",
    [
        {"port": FLAT_PORT, "focal_widths": 0.77},
        {"port": DOME},
        {"lens": "fisheye", "focal_widths": 0.44},
    ],
    ids=["flat port", "dome", "fisheye"],
)
def test_every_pixel_shows_the_range_of_what_its_ray_meets(changes: dict[str, object]) -> None:
    from aquaflow.lab.synthetic.dive import camera_of
    from aquaflow.lab.synthetic.render import render
    from aquaflow.lab.synthetic.water import WATER_TYPES

    # A sandy floor is flat but for ripples of some centimetres: the range follows from the ray.
    asked = {"scene": "flat_sand", "frames": 2, "width": 64, "height": 48, "camera_pitch_deg": 90}
    config = SyntheticConfig.model_validate(asked | changes)
    scene, path = build(config)
    camera, t = camera_of(config), np.array([0.0])
    R, centre = (path.R_ws.T @ path.R_wc(t))[0], path.centre_s(t)[0]
    view = render(scene, camera, R, centre, WATER_TYPES["clear"], 1)

    origins, rays = rays_of_pixels(camera, camera.pixel_centres().reshape(-1, 2))
    starts, down = centre + origins @ R.T, (rays @ R.T)[:, 2]
    points = starts + view.range_m.reshape(-1, 1) * (rays @ R.T)
    floor = -scene.field.height(*(torch.tensor(points[:, k], dtype=torch.float32) for k in (0, 1)))
    on_floor = np.abs(points[:, 2] - floor.numpy()) < 0.002
    assert down.min() > 0.0
    # What is not the floor is one of the few objects that lie on it.
    assert on_floor.mean() > 0.9


def test_the_port_of_a_dive_is_in_its_camera_file(tmp_path: Path) -> None:
    asked = {"frames": 2, "width": 32, "height": 24, "port": FLAT_PORT, "focal_widths": 0.77}
    write_dive(tmp_path / "dive", SyntheticConfig.model_validate(asked))
    assert read_truth(tmp_path / "dive").camera.port == FlatPort(0.05, 0.01)


def test_attenuation_follows_the_heading_where_it_is_asked_to() -> None:
    water = WATER_TYPES["coastal_1C"]
    north, south, down = np.array([[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8], [0.0, 0.0, 1.0]])
    found = [np.array(water.looking(axis, 0.5).beta_a) for axis in (north, south, down)]
    for beta_a, factor in zip(found, (1.3, 0.7, 1.0), strict=True):
        np.testing.assert_allclose(beta_a, factor * np.array(water.beta_a))
    assert water.looking(north, 0.0) is water


def test_a_dive_of_directional_water_differs_from_one_of_even_water(tmp_path: Path) -> None:
    pictures = []
    for change in (0.0, 0.5):
        settings = {"frames": 3, "width": 64, "height": 48, "directional_attenuation": change}
        write_dive(tmp_path / str(change), SyntheticConfig.model_validate({**BARE, **settings}))
        picture = cv2.imread(str(tmp_path / str(change) / "images" / "000001.png"))
        assert picture is not None
        pictures.append(picture.astype(float))
    assert np.abs(pictures[0] - pictures[1]).mean() > 1.0
