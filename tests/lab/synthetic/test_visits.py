"""Two days at one synthetic site: what stays, and what was planted."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import build, write_dive
from aquaflow.lab.synthetic.site import SurveySite, site_of

SITE = {"frames": 12, "width": 48, "height": 36, "fps": 6.0, "margin_m": 1.0}
VISIT = {"over": SITE, "offset_m": (0.2, -0.1), "heading_deg": 30.0}
BOX = {"kind": "box", "at_m": (1.5, 0.2), "half_m": 0.1}


def site(**settings: object) -> SurveySite:
    return site_of(SyntheticConfig.model_validate(SITE | settings))


def test_another_day_goes_another_way_over_the_same_floor() -> None:
    first, second = site(), site(visit=VISIT, seed=9, altitude_m=1.8, water="oceanic_II")
    np.testing.assert_array_equal(first.relief.height, second.relief.height)
    assert first.relief.area == second.relief.area
    t = np.array([0.0, 1.0])
    assert np.linalg.norm(first.path.centre_w(t) - second.path.centre_w(t), axis=1).min() > 0.1
    turn = np.degrees(np.arccos(np.clip(
        (np.trace(first.path.R_wc(t)[0].T @ second.path.R_wc(t)[0]) - 1.0) / 2.0, -1.0, 1.0
    )))  # fmt: skip
    assert 20.0 < turn < 40.0  # 30 degrees, and each day's sway


def test_an_object_that_is_placed_stands_on_the_floor_and_is_all_that_differs() -> None:
    bare, one = site(), site(placed=[BOX])
    np.testing.assert_array_equal(bare.relief.height, one.relief.height)
    differs = one.crests - bare.crests > 0.01
    area = one.relief.area
    rows, columns = np.nonzero(differs)
    x = area.x0 + (columns + 0.5) * area.cell
    y = area.y0 + (rows + 0.5) * area.cell
    assert abs(x.mean() - 1.5) < 0.02
    assert abs(y.mean() - 0.2) < 0.02
    assert 0.12 < (one.crests - bare.crests)[differs].mean() < 0.22


def test_bleaching_makes_a_patch_lighter_and_greyer_and_nothing_else() -> None:
    patch = {"at_m": (1.5, 0.2), "radius_m": 0.2, "share": 0.8}
    before = build(SyntheticConfig.model_validate(SITE))[0].floor._atlas
    after = build(SyntheticConfig.model_validate(SITE | {"bleached": [patch]}))[0].floor._atlas
    changed = (before != after).any(dim=1)[0]
    assert 0 < changed.sum() < 0.2 * changed.numel()
    old, new = before[0, :3, changed], after[0, :3, changed]
    assert new.mean() > 1.2 * old.mean()
    saturation = [(c.amax(0) - c.amin(0)) / c.amax(0) for c in (old, new)]
    assert saturation[1].mean() < 0.7 * saturation[0].mean()


def test_the_light_of_a_visit_dims_its_pictures(tmp_path: Path) -> None:
    def mean_of(name: str, light: tuple[float, float, float]) -> npt.NDArray[np.float64]:
        of_visit = SITE | {"frames": 2, "visit": {"over": SITE, "light": light}}
        write_dive(tmp_path / name, SyntheticConfig.model_validate(of_visit))
        picture = cv2.imread(str(min((tmp_path / name / "images").iterdir())))
        assert picture is not None
        return np.asarray(picture[..., ::-1].mean(axis=(0, 1)), np.float64)

    bright, dim = mean_of("bright", (1.0, 1.0, 1.0)), mean_of("dim", (0.5, 0.8, 1.0))
    assert dim[0] < 0.9 * bright[0]
    assert dim[1] < 0.97 * bright[1]
    assert dim[2] == pytest.approx(bright[2], rel=0.01)


@pytest.mark.parametrize(
    "wrong", [{"visit": {"over": SITE, "turn": 3}}, {"placed": [{"half_m": 0.1}]}]
)
def test_unknown_and_missing_settings_of_a_visit_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"visit|placed"):
        SyntheticConfig.model_validate(SITE | wrong)
