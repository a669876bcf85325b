"""A scene's water: fitted to what its views saw, taken on, and mended after optimisation."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch

from aquaflow.mapping.gaussians.gaussians import raw_colour
from aquaflow.mapping.scene import Scene, orientations
from aquaflow.render.activation import radiance
from aquaflow.render.transfers import water_in, water_out
from aquaflow.render.views import View
from aquaflow.water.estimation import WaterEstimate, estimating, models_for
from aquaflow.water.exposure import gain_of, log_gains_of, set_log_gains
from aquaflow.water.image_formation import WaterParameters
from aquaflow.water.nearest import kept_by
from aquaflow.water.posed_picture import PosedPicture
from aquaflow.water.shading import shading_basis
from aquaflow.water.sightings import sighting


@torch.no_grad()
def rebalance(scene: Scene) -> None:
    """After steps that changed medium and exposures: what is nearest keeps its colours."""
    if scene.balance is None or scene.seen_nearest is None or not scene.medium.active:
        return
    near, views = scene.seen_nearest
    which = water_in(near.view, scene.device, torch.int64)
    basis, water = shading_basis(near.xy), _water_of(scene, views, which)
    log_gain = (basis @ scene.shading)[:, None]
    if scene.exposes:
        log_gain = log_gain + log_gains_of(views)[near.view]
    z = water_in(near.z, scene.device)
    T, veil = (water_out(part) for part in (water.transmission(z), water.backscatter(z)))
    veil = veil * np.exp(basis @ scene.unevenness())[:, None]
    clean = np.maximum(near.colour / np.exp(log_gain) - veil, 0.0) / T
    scene.balance = replace(scene.balance, gain=kept_by(near, clean.T))


def fitting_water(
    scene: Scene, views: Sequence[View], generator: torch.Generator
) -> Generator[None, None, tuple[WaterEstimate | None, list[View]]]:
    """Estimate water, shading and exposure from what ``views`` saw; the scene stays as it is.

    Pauses every few milliseconds. Returns the estimate, None while too little is seen from
    several ranges, and the views that it was fitted to: those that still have their pixels.
    """
    if not scene.config.fit or len(scene.gaussians) == 0:
        return None, []
    pictures, fitted = [], []
    for view in views:
        if view.has_pixels:
            shown = scene.show(view)
            pictures.append(PosedPicture(view, shown.z, shown.alpha))
            fitted.append(view)
            yield
    if not fitted:
        return None, []
    seed = int(torch.randint(2**31, (1,), generator=generator))
    seen = yield from sighting(pictures, np.random.default_rng(seed))
    yield
    with torch.no_grad():
        sea = scene.medium(orientations(fitted, scene.device))
    B_res, d = water_out(sea.B_res), water_out(sea.d)
    models, priors = models_for(scene.config), scene.config.priors
    steps = estimating(seen, B_res, d, models, priors, pictures)
    return (yield from steps), fitted


def adopt_water(
    scene: Scene, estimate: WaterEstimate, fitted: Sequence[View], dive: Sequence[View]
) -> None:
    """Let the estimate hold; the pictures of the map stay as they are.

    All views of the ``dive`` get an exposure.
    """
    with _unchanged_by_failure(scene):
        _adopt(scene, estimate, fitted, dive)


@contextmanager
def _unchanged_by_failure(scene: Scene) -> Iterator[None]:
    """The water as it was, if the block raises: half of a new one fits no picture."""
    active = scene.medium.active
    medium = {name: each.clone() for name, each in scene.medium.state_dict().items()}
    before = vars(scene).copy()
    try:
        yield
    except Exception:
        scene.medium.load_state_dict(medium)
        scene.medium.active = active
        vars(scene).update(before)
        scene.gain_maps.clear()
        raise


@torch.no_grad()
def _adopt(
    scene: Scene, estimate: WaterEstimate, fitted: Sequence[View], dive: Sequence[View]
) -> None:
    """Let the estimate hold, and give every Gaussian the radiance that looks the same in it.

    The same from the camera nearest to it: where it is seen best.
    """
    shown, (_, z, nearest) = (
        scene.bake_parameters(list(fitted))["raw_colours"],
        scene.nearest_cameras(fitted),
    )
    old = _water_of(scene, fitted, nearest) if scene.medium.active else None
    old_gains = torch.stack([gain_of(view) for view in fitted])
    scene.medium.active = estimate.model.water
    if estimate.model.water:
        found = (estimate.beta_a, estimate.B_inf, estimate.b, estimate.unevenness)
        scene.medium.set_water(*(water_in(v, scene.device) for v in found))
        scene.centre_water(fitted)
    scene.shading, scene.exposes = estimate.shading, estimate.model.exposure
    scene.beta_a_sigma, scene.water_evidence = estimate.beta_a_sigma, estimate.evidence
    scene.balance, scene.range_variance = estimate.balance, estimate.range_variance
    if estimate.nearest is not None:
        scene.seen_nearest = estimate.nearest, list(fitted)
    scene.gain_maps.clear()
    set_log_gains(dive, fitted, estimate.exposure)

    new = _water_of(scene, fitted, nearest) if scene.medium.active else None
    seen = radiance(shown)
    if old is not None:
        seen = seen * old.transmission(z) + old.backscatter(z)
    new_gains = torch.stack([gain_of(view) for view in fitted])
    seen = seen * (old_gains / new_gains)[nearest]
    wanted = raw_colour(seen if new is None else new.restore(seen, z)[0])
    raw = scene.gaussians.parameters["raw_colours"]
    # A decoder's residuals come on top again.
    raw.copy_(wanted if scene.neural is None else wanted + (raw - shown))


def _water_of(
    scene: Scene,
    views: Sequence[View],
    which: torch.Tensor,  # [N] int64
) -> WaterParameters:
    """The water for N points, each seen from its own view: beta_a is [N, 3]."""
    water: WaterParameters = scene.medium(orientations(views, scene.device))
    return replace(water, beta_a=water.beta_a[which])
