"""Two days at one synthetic site: what stays, and what was planted."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.synthetic import SyntheticConfig
from aquaflow.synthetic.dive import build
from aquaflow.synthetic.site import Site, site_of

SITE = {"frames": 12, "width": 96, "height": 72, "fps": 6.0, "margin_m": 1.0}
VISIT = {"seed": 9, "shift_m": (0.2, -0.1), "turn_deg": 30.0, "altitude_m": 1.8}
BOX = {"kind": "box", "at_m": (1.5, 0.2), "half_m": 0.1}


def site(**settings: object) -> Site:
    return site_of(SyntheticConfig.model_validate(SITE | settings))


def test_another_day_goes_another_way_over_the_same_floor() -> None:
    first, second = site(), site(visit=VISIT, water="oceanic_II")
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


def test_the_light_of_a_day_dims_the_floor_and_the_objects() -> None:
    of_one_day = SITE | {"placed": [BOX]}
    bright = build(SyntheticConfig.model_validate(of_one_day | {"visit": {}}))[0]
    dim = build(SyntheticConfig.model_validate(of_one_day | {"visit": {"light": (0.5, 0.8, 1.0)}}))[
        0
    ]
    ratio = dim.floor._atlas[0, :3].mean(dim=(1, 2)) / bright.floor._atlas[0, :3].mean((1, 2))
    np.testing.assert_allclose(ratio.numpy(), (0.5, 0.8, 1.0), rtol=0.01)
    np.testing.assert_allclose(
        np.array(dim.shapes[-1].paint) / bright.shapes[-1].paint, (0.5, 0.8, 1.0)
    )


@pytest.mark.parametrize("wrong", [{"visit": {"turn": 3}}, {"placed": [{"half_m": 0.1}]}])
def test_unknown_and_missing_settings_of_a_visit_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"visit|placed"):
        SyntheticConfig.model_validate(SITE | wrong)
