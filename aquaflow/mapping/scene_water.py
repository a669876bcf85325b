"""A scene's water: fitted to what its views saw, taken on, and mended after optimisation."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch

from aquaflow.base.errors.failures import Failures
from aquaflow.config import MediumConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.looks import looks, recoloured, water_of
from aquaflow.mapping.scene import Scene, orientations
from aquaflow.mapping.tiles import Sphere, Tiles
from aquaflow.render.transfers import water_in, water_out
from aquaflow.render.views import View, in_time
from aquaflow.water.estimation import WaterEstimate, estimating, models_for
from aquaflow.water.exposure import log_gains_of, set_log_gains
from aquaflow.water.model import shading_basis
from aquaflow.water.nearest import kept_by
from aquaflow.water.observations import run_to_end
from aquaflow.water.sightings import MIN_VIEWS, PosedPicture, sighting
from aquaflow.water.white_balance import WhiteBalance


@torch.no_grad()
def rebalance(scene: Scene) -> None:
    """After steps that changed medium and exposures: what is nearest keeps its colours."""
    if scene.balance is None or scene.seen_nearest is None or not scene.medium.active:
        return
    near, views = scene.seen_nearest
    which = water_in(near.view, scene.device, torch.int64)
    basis, water = shading_basis(near.xy), water_of(scene, views, which)
    log_gain = (basis @ scene.shading)[:, None]
    if scene.exposes:
        log_gain = log_gain + log_gains_of(views)[near.view]
    z = water_in(near.z, scene.device)
    T, veil = (water_out(part) for part in (water.transmission(z), water.backscatter(z)))
    veil = veil * np.exp(basis @ scene.unevenness())[:, None]
    clean = np.maximum(near.colour / np.exp(log_gain) - veil, 0.0) / T
    scene.balance = replace(scene.balance, gain=kept_by(near, clean.T))


def fitting_water(
    scene: Scene,
    views: Sequence[View],
    generator: torch.Generator,
    come_to: Callable[[View], None] | None = None,
) -> Generator[None, None, tuple[WaterEstimate | None, list[View]]]:
    """Estimate water, shading and exposure from what ``views`` saw; the scene stays as it is.

    ``come_to`` is told of each view before it is drawn. Pauses every few milliseconds. Returns the
    estimate, None while too little is seen from several ranges, and the views that it was fitted
    to: those that still have their pixels.
    """
    if not scene.config.fit or len(scene.gaussians) == 0:
        return None, []
    pictures, fitted = [], []
    for view in views:
        if view.has_pixels:
            if come_to is not None:
                come_to(view)
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

    The same from that camera of the dive which is nearest to it: where it is seen best.
    """
    shown, (_, z, nearest) = (
        scene.bake_parameters(list(dive))["raw_colours"],
        scene.nearest_cameras(dive),
    )
    before = looks(scene, dive, nearest, z)
    scene.medium.active = estimate.model.water
    if estimate.model.water:
        found = [estimate.beta_a, estimate.B_inf, estimate.b, estimate.unevenness]
        found += [] if estimate.lamp is None else [estimate.glow]
        scene.medium.set_water(*(water_in(v, scene.device) for v in found))
        scene.centre_water(fitted)
    scene.lamp = estimate.lamp
    scene.shading, scene.exposes = estimate.shading, estimate.model.exposure
    scene.beta_a_sigma, scene.water_evidence = estimate.beta_a_sigma, estimate.evidence
    scene.balance, scene.range_variance = _as_chosen(scene, estimate), estimate.range_variance
    scene.lightness_over_range = estimate.lightness_over_range
    if estimate.nearest is not None:
        scene.seen_nearest = estimate.nearest, list(fitted)
    scene.gain_maps.clear()
    set_log_gains(dive, fitted, estimate.exposure)

    wanted = recoloured(shown, before, looks(scene, dive, nearest, z))
    raw = scene.gaussians.parameters["raw_colours"]
    # A decoder's residuals come on top again.
    raw.copy_(wanted if scene.neural is None else wanted + (raw - shown))


def _as_chosen(scene: Scene, estimate: WaterEstimate) -> WhiteBalance | None:
    """The estimate's white balance, with what was chosen on top of the one before: a cast over what
    is nearest hardly changes with the water."""
    if estimate.balance is None or scene.balance is None:
        return estimate.balance
    return replace(estimate.balance, chosen=scene.balance.chosen)


# --------------------------------------------------------------------------------------------------
# Which views it is fitted to: a patch of the surface says something where several see it.

GROUP = 5
"""Views of one ground: two more than must see a patch, as none shows all of it."""
NEAR = 0.5
"""Distance of two grounds over their radius up to which they are mostly the same."""
SHARING = 0.5
"""Share of the views that are spread over a dive's time that must see the same ground as others."""


def views_to_fit(
    views: Sequence[View],
    seen: Mapping[int, Sphere],  # by keyframe
    most: int,
) -> list[View]:
    """Up to ``most`` of the views, in the order of their frames: those spread over the dive's time
    where they see the same ground; if not, as in long dives, groups that do, each from as different
    ranges as there are."""
    ordered = in_time(views)
    count = min(most, len(ordered))
    spread = [ordered[i] for i in np.linspace(0, len(ordered) - 1, count).astype(int)]
    known = [view for view in ordered if view.keyframe in seen]
    if len(ordered) <= most or len(known) <= most or _share_ground(spread, seen):
        return spread
    ground = np.stack([seen[view.keyframe].centre for view in known])
    places = np.stack([view.T_wc.t for view in known])
    chosen, groups = set[int](), max(most // GROUP, 1)
    for anchor in np.linspace(0, len(known) - 1, 2 * groups + 1).astype(int)[1::2]:
        reach = NEAR * seen[known[anchor].keyframe].radius
        near = np.flatnonzero(np.linalg.norm(ground - ground[anchor], axis=1) <= reach)
        by_range = near[np.argsort(np.linalg.norm(places[near] - ground[anchor], axis=1))]
        spread_over = np.linspace(0, len(near) - 1, min(GROUP, most)).astype(int)
        chosen |= set(by_range[spread_over].tolist())
    return [known[i] for i in sorted(chosen)]


def _share_ground(views: Sequence[View], seen: Mapping[int, Sphere]) -> bool:
    """Whether most of the ``views`` see ground that enough others see; True where it is unknown."""
    spheres = [seen[view.keyframe] for view in views if view.keyframe in seen]
    if not spheres:
        return True
    centres = np.stack([sphere.centre for sphere in spheres])
    radii = np.array([sphere.radius for sphere in spheres])
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1)
    near = apart <= NEAR * np.maximum(radii[:, None], radii)
    return bool((near.sum(axis=1) >= MIN_VIEWS).mean() >= SHARING)


# --------------------------------------------------------------------------------------------------
# When the water is fitted, and that no frame waits for it: a few steps with each new view.

log = logging.getLogger(__name__)

OTHER_UNIT = 0.02
"""Relative change of scale from which on ranges seen before and after do not belong together.
Places that moved are left out one by one, where the map's range no longer agrees."""
STEPS = 2
"""Of a fit with each new view: at 480 px one of them, a picture of the map or a few steps of the
solver, takes 10 to 30 ms of two cores."""


class WaterFitting:
    """Fits a scene's water after a number of views, at every doubling of it, and on request."""

    def __init__(
        self,
        config: MediumConfig,
        scene: Scene,
        generator: torch.Generator,
        failures: Failures,
        tiles: Tiles | None = None,
    ) -> None:
        """``tiles`` know on what ground the keyframes have looked."""
        self.config, self.scene, self.failures = config, scene, failures
        self._tiles = Tiles() if tiles is None else tiles
        self._random = generator
        self.next_fit = config.first_fit_views
        """Number of views at which the next fit begins."""
        self._under_way: Generator[None, None, None] | None = None

    def go_on(self, views: Sequence[View], here: Sequence[View] | None = None) -> bool:
        """A few steps, if there is a fit to be made; True if it has ended with them.

        ``here``: those of the ``views`` whose ground is in memory, which it looks at; None: all.
        """
        here = views if here is None else here
        if self._under_way is None and here and len(views) >= self.next_fit:
            self._under_way = self._fitting(views, here)
        if self._under_way is None:
            return False
        ended = True
        with self.failures.contain("water fit"):
            ended = sum(1 for _ in itertools.islice(self._under_way, STEPS)) < STEPS
        if ended:
            self._end(views)
        return ended

    def at_once(self, views: Sequence[View], come_to: Callable[[View], None] | None = None) -> None:
        """A whole fit, from its beginning; ``come_to`` lets a view's ground be in memory."""
        with self.failures.contain("water fit"):
            run_to_end(self._fitting(views, views, come_to))
        self._end(views)

    def follow_moves(self, moves: Mapping[int, Sim3]) -> None:
        """Keyframes have moved: a fit under way begins again if the map's unit did."""
        if any(abs(move.scale - 1.0) > OTHER_UNIT for move in moves.values()):
            self.begin_again()

    def begin_again(self) -> None:
        """Drop a fit that is under way: what it has seen is no longer where it was. It begins again
        with the next view."""
        self._under_way = None

    def merge(self, views: Sequence[View]) -> None:
        """The map has those of another: a fit to all ``views`` begins with the next one."""
        self.begin_again()
        self.next_fit = min(self.next_fit, len(views))

    def _end(self, views: Sequence[View]) -> None:
        self._under_way = None
        self.next_fit = max(self.next_fit, 2 * len(views))

    def _fitting(
        self,
        views: Sequence[View],
        here: Sequence[View],
        come_to: Callable[[View], None] | None = None,
    ) -> Generator[None, None, None]:
        """To some of those ``here``; pauses every few milliseconds."""
        looked_at = views_to_fit(here, self._tiles.seen, self.config.fit_views)
        fit = fitting_water(self.scene, looked_at, self._random, come_to)
        estimate, fitted = yield from fit
        if estimate is None:
            return
        adopt_water(self.scene, estimate, fitted, in_time(views))
        log.info(
            "water fitted: %s, beta_a %s per map unit (relative sigma %s)",
            estimate.model,
            estimate.beta_a.round(3).tolist(),
            estimate.beta_a_sigma,
        )
