"""The oracle: a prior that looks the pictures of one dive up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.config import PriorConfig
from aquaflow.prior.factory import make_prior
from aquaflow.prior.oracle import TRUTH, OracleDescriber, TrueView, write_oracle
from aquaflow.tracking.learned import unscaled_depth
from tests.tracking.tracking_scenes import CAMERA, SeaFloor, lawn_path

POSES = [lawn_path(8)[0], lawn_path(8)[6]]


@pytest.fixture(scope="module")
def views() -> list[TrueView]:
    floor, found = SeaFloor(), []
    for T_wc in POSES:
        rays = CAMERA.unproject(CAMERA.pixel_centres())
        in_camera = rays * floor.depth(T_wc)[..., None]
        ranges = np.linalg.norm(in_camera, axis=-1)
        found.append(TrueView(floor.picture(T_wc), T_wc.apply(in_camera), ranges, T_wc))
    return found


@pytest.fixture(scope="module")
def folder(views: list[TrueView], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("oracle") / "prior"
    write_oracle(out, views, CAMERA, range_sigma=0.05)
    return out


def test_it_finds_matches_and_ranges_of_the_pictures_it_knows(
    folder: Path, views: list[TrueView]
) -> None:
    prior = make_prior(PriorConfig(kind="folder", folder=folder))
    assert (prior.name, prior.ranged) == ("oracle", True)
    a, b = (prior.encode(view.picture, CAMERA) for view in views)
    pair = prior.decode(a, b)
    T_ba = POSES[1].inverse() @ POSES[0]
    rays = CAMERA.unproject(CAMERA.pixel_centres())
    truth = CAMERA.project(T_ba.apply(rays * SeaFloor().depth(POSES[0])[..., None]))
    assert pair.valid.mean() > 0.5
    assert np.median(np.linalg.norm(pair.matches - truth, axis=-1)[pair.valid]) < 0.3
    for view, X in zip(views, (pair.X_a, pair.X_b), strict=True):
        assert X is not None
        error = np.log(np.linalg.norm(X, axis=-1) / view.ranges)
        assert 0.02 < np.std(error) < 0.06  # 5 % of cells, smoothed between them
        Q = pair.Q_a
        assert Q is not None
        np.testing.assert_allclose(Q, 0.05**-2, rtol=1e-3)
        assert unscaled_depth(CAMERA, X, Q) is not None


def test_a_dense_one_knows_points_and_descriptors_of_all_pixels(
    views: list[TrueView], tmp_path: Path
) -> None:
    out = tmp_path / "prior"
    write_oracle(out, views, CAMERA, range_sigma=0.05, dense=True)
    oracle = OracleDescriber(out)
    assert oracle.describes == "pixels"
    pair = oracle.compare(*(oracle.features(view.picture) for view in views), CAMERA, CAMERA)
    there = pair.dense()
    assert there is not None
    moved = there.flow(CAMERA.height, CAMERA.width)
    T_ba = POSES[1].inverse() @ POSES[0]
    pixels = CAMERA.pixel_centres()
    truth = CAMERA.project(
        T_ba.apply(CAMERA.unproject(pixels) * SeaFloor().depth(POSES[0])[..., None])
    )
    seen = ((truth > 0.0) & (truth < [CAMERA.width, CAMERA.height])).all(-1)
    assert np.median(np.linalg.norm(pixels + moved - truth, axis=-1)[seen]) < 2.0


def test_of_other_pictures_it_knows_nothing(folder: Path) -> None:
    prior = make_prior(PriorConfig(kind="folder", folder=folder))
    other = np.random.default_rng(0).integers(0, 256, (CAMERA.height, CAMERA.width, 3), np.uint8)
    encoding = prior.encode(other, CAMERA)
    pair = prior.decode(encoding, encoding)
    assert pair.X_a is not None
    assert np.isnan(pair.X_a).all()
    assert pair.Q_a is not None
    assert not pair.Q_a.any()
    assert pair.valid.mean() > 0.8, "flow finds what does not move"


def test_a_folder_in_use_is_not_written_to(folder: Path, views: list[TrueView]) -> None:
    with pytest.raises(InputError, match="is not empty"):
        write_oracle(folder, views, CAMERA, 0.05)


def test_without_pictures_there_is_no_oracle(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no picture with a true range"):
        write_oracle(tmp_path / "new", [], CAMERA, 0.05)


def test_a_changed_file_is_refused(views: list[TrueView], tmp_path: Path) -> None:
    write_oracle(tmp_path / "prior", views, CAMERA, 0.05)
    (tmp_path / "prior" / TRUTH).write_bytes(b"something else")
    with pytest.raises(InputError, match="is not the file that was exported"):
        make_prior(PriorConfig(kind="folder", folder=tmp_path / "prior"))
