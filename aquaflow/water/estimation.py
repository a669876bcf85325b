"""The water, the camera's shading and the views' exposures, from points seen at several ranges.

A point's colour J is unknown but the same from everywhere; what changes with range is the water:
the contrast between bright and dark points decays by exp(-beta z), and their common level moves
towards B_inf. Photometric gradients alone hardly move the water, because every Gaussian's colour
can follow its error.

Lamps and lenses darken the picture towards its edge, and near ground is seen near the edge: left
out, that looks like water. So does light that changes while the vehicle climbs. Sunlit water shines
more brightly the less one looks down. Lamps beside the camera light what is near, and what fades
with their light is not all water. And in air or clear water there is nothing to find at all. Which
of these are there is decided by the models' marginal likelihoods (Laplace's method) under stated
priors, with errors that neighbours share counted once.

A dive is in water unless there is evidence for clear water, and the likeliest water would not show.
Where little can be seen of it, the usual water is taken, with its uncertainty.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
import numpy.typing as npt

from aquaflow.config import MediumConfig, WaterPriorsConfig
from aquaflow.optimise.least_squares import Ending, NormalEquations, Rules, minimise
from aquaflow.optimise.robust import SoftL1, sigma_of
from aquaflow.water.model import (
    BELIEVED,
    RATE_ROWS,
    Derivatives,
    Lamp,
    Model,
    Prediction,
    WaterModel,
    rate_rows,
    with_lamp,
)
from aquaflow.water.nearest import Nearest, nearest_of, white_balance
from aquaflow.water.observations import Observations, lightness_over_range, variance_over_range
from aquaflow.water.open_sightings import with_open_water
from aquaflow.water.sightings import PosedPicture
from aquaflow.water.white_balance import WhiteBalance

Array = npt.NDArray[np.float64]

MIN_POINTS = 100
"""Fewer say nothing about the water."""
WATER_IS_USUAL = 5.0
"""Log odds for water before anything is seen: one dive in 150 is in air or in water as clear."""
NEGLIGIBLE_DEPTH = 0.06
"""Optical depth at the median range up to which no eye sees water: as much as maps lose anyway."""
VISIBLE_DEPTH = 0.12
"""Optical depth at the median range from which water shows: a ninth of the light is gone. Rendered
scenes without water look like 0.02 to 0.05."""
LAMP_SHOWS = 150.0
"""Log odds for a lamp from which it is taken as seen: up to 5 by daylight, 84 on AUV surveys, which
see what their strobes light from one range; 240 to 2100 on ten rendered dives with lamps."""
EVERY_MODEL = tuple(
    Model(*parts) for parts in product((False, True), repeat=4) if Model(*parts).is_possible
)
"""With and without each part but lamps, which are looked for in what is found (``with_lamp``).
Shading and unevenness together only where open water is seen."""


@dataclass(frozen=True)
class WaterEstimate:
    """What lies between the points and the pictures; rates per map unit."""

    model: Model
    """Which of the parts below are there; the others have no effect."""
    beta_a: Array
    """[3]"""
    B_inf: Array
    """[3]"""
    b: Array
    """[3]"""
    lamp: Lamp | None
    glow: Array
    """[3] of the lamp's light that the water returns, as from any range; 0 without a lamp."""
    unevenness: Array
    """[5] coefficients of the backscatter's log-gain over the picture."""
    beta_a_sigma: list[float] | None
    """[3] relative standard deviation of beta_a; None without water."""
    shading: Array
    """[5] coefficients of the log-gain."""
    exposure: Array
    """[V, 3] log-gain of each view, of mean zero."""
    evidence: float | None
    """Log odds of water, WATER_IS_USUAL not counted; None: water or clear water was not tried."""
    nearest: Nearest | None
    """What was seen nearest; None without water."""
    balance: WhiteBalance | None
    """What restored pictures are shown in; None without water."""
    range_variance: tuple[float, float]
    """Relative variance of the points' colours that follows from their range: as the camera saw
    them, and without water."""
    lightness_over_range: tuple[float, float] | None
    """Of the same ground, far over near: as the camera saw it, and without water; None where too
    little was seen from near and far, and without water."""


def models_for(config: MediumConfig) -> list[Model]:
    """The models that the config allows."""
    water = {config.enabled, config.enabled and not config.off_when_clear}
    return [
        model
        for model in EVERY_MODEL
        if model.water in water
        and (config.shading or not model.shading)
        and (config.uneven or not model.uneven)
        and (config.exposure or not model.exposure)
    ]


def estimating(
    observations: Observations,
    B_res: Array,  # [3]
    d: Array,  # [3] 1 / map unit
    models: Sequence[Model] = EVERY_MODEL,
    priors: WaterPriorsConfig = BELIEVED,
    pictures: Sequence[PosedPicture] = (),  # by the number of the view; may show open water
) -> Generator[None, None, WaterEstimate | None]:
    """Fit ``models`` and keep the likeliest; None where too few points are seen several times.

    Pauses every few milliseconds.
    """
    if observations.points < MIN_POINTS:
        return None

    def problems(seen: Observations, models: Sequence[Model]) -> list[WaterModel]:
        return [WaterModel(seen, model, B_res, d, priors) for model in models]

    some = [model for model in models if not model.takes_open_water]
    fits = yield from fit_likeliest(problems(observations, some))
    dry, wet = (
        next((fit for fit in fits if fit.problem.model.water is water), None)
        for water in (False, True)
    )
    odds = None if dry is None or wet is None else log_odds_of_water(dry, wet)
    if wet is None or (odds is not None and _is_clear(wet, odds)):
        assert dry is not None
        return (yield from _estimate(observations, dry, odds))
    wet = yield from _lamplit(wet, problems(observations, with_lamp(some)))
    yield
    found = wet.prediction
    extended = yield from with_open_water(observations, pictures, found.trial, found.J.mean(axis=1))
    if extended.points > observations.points:
        wet_models = [model for model in models if model.water]
        wet_models = with_lamp(wet_models) if wet.problem.model.lamp else wet_models
        (wet,) = yield from fit_likeliest(problems(extended, wet_models))
    return (yield from _estimate(observations, wet, odds, pictures))


def _estimate(
    observations: Observations,
    best: WaterFit,
    odds: float | None,
    pictures: Sequence[PosedPicture] = (),
) -> Generator[None, None, WaterEstimate]:
    """What the fit, perhaps to open water too, says of the observations of the surface."""
    shown = yield from _as_pictures_show(best)
    seen, trial, water = observations, shown.prediction.trial, best.problem
    range_variance = [variance_over_range(seen, seen.colour)] * 2
    sigma = nearest = balance = lightness = None
    if water.model.water:
        sigma = _beta_a_sigma(best)
        J = shown.prediction.J[:, : seen.points]
        nearest = yield from nearest_of(seen, pictures, trial, J.mean(axis=1))
        balance = white_balance(nearest, water, trial, J, sigma)
        clean = water.without_water(trial, seen.view, seen.xy, seen.z, seen.colour)
        range_variance[1] = variance_over_range(seen, clean.T)
        far = [lightness_over_range(seen, each) for each in (seen.colour, clean.T * balance.gain)]
        lightness = None if far[0] is None or far[1] is None else (far[0], far[1])
    return WaterEstimate(
        water.model,
        trial.beta_a,
        trial.B_inf,
        trial.b,
        trial.lamp,
        trial.glow,
        trial.unevenness,
        sigma,
        trial.shading,
        trial.exposure,
        odds,
        nearest,
        balance,
        (range_variance[0], range_variance[1]),
        lightness,
    )


def _as_pictures_show(best: WaterFit) -> Generator[None, None, WaterFit]:
    """The same water by a lamp at the camera, as pictures are restored: what its mounting and the
    ground's normals do, of which pictures know nothing, is on the mean in its fall and shading."""
    if not best.problem.model.lamp:
        return best
    return (yield from descend(best.problem.at_the_camera(best.x), best.x, best.noise))


def _lamplit(wet: WaterFit, problems: Sequence[WaterModel]) -> Generator[None, None, WaterFit]:
    """The likeliest of the problems, all with a lamp, if that is far likelier than ``wet``."""
    if not problems:
        return wet
    richest = max(problems, key=lambda problem: problem.size)
    first = yield from descend(richest, richest.adopt(wet.problem, wet.x), wet.noise)
    if first.log_evidence < wet.log_evidence:
        return wet
    (lit,) = yield from fit_likeliest(problems)
    # Evidence is comparable at one noise only: that of the better fit.
    dark = yield from descend(wet.problem, wet.x, lit.noise)
    return lit if lit.log_evidence - dark.log_evidence > LAMP_SHOWS else wet


def _is_clear(wet: WaterFit, odds: float) -> bool:
    """By evidence, if the likeliest water would not show; or as it takes next to nothing."""
    depth = float((np.exp(wet.x[:3]) * wet.problem.median_range).max())
    return depth < NEGLIGIBLE_DEPTH or (odds + WATER_IS_USUAL < 0.0 and depth < VISIBLE_DEPTH)


def log_odds_of_water(dry: WaterFit, wet: WaterFit) -> float:
    """Against a scene without any, and one that looks no more like water than clear scenes do."""
    return min(wet.log_evidence - dry.log_evidence, -log_odds_clear(wet))


def _beta_a_sigma(fit: WaterFit) -> list[float]:
    variance = np.maximum(np.diag(attenuation_covariance(fit)), 0.0)
    return list(np.sqrt(variance).tolist())


# --------------------------------------------------------------------------------------------------
# Clear water, or air: its odds against water that dims and veils what is far.
#
# Contrast is never quite the same from near and from far, as ranges and poses are not exact; scenes
# without water look like one of a hundredth of an optical depth, in all colours alike. A fit that
# finds no more than this found clear water.

OPTICAL_DEPTH, OPTICAL_DEPTH_SIGMA = 0.02, 1.0
"""At the median range, and its sigma in the log. Found on rendered dives without water (reef, flat
sand, pipe): 0.01 to 0.05."""
RATIO_SIGMA = 0.15
"""Log of red over green and of blue over green: 0.02 to 0.1 on the same dives."""
CONTRAST_SIGMA = 0.03
"""Optical depth, at the median range, by which a scene's contrast changes without water, alike in
RGB: of 50 rendered dives in water most change by less than 0.01, some by 0.05."""
ROWS = rate_rows(OPTICAL_DEPTH_SIGMA, RATIO_SIGMA, RATIO_SIGMA)
"""Whitens log beta_a of clear water."""
LEAST_DEPTH = 1e-6
"""Guards the division by the optical depth of water that is not there."""
LEAST_INFORMATION = 1e-6
"""Guards the inverse where the observations say nothing of a direction."""


def log_odds_clear(
    fit: WaterFit,  # with water
) -> float:
    """Log odds of clear water against the water of the fit's prior: what the observations say of
    log beta_a under the prior of the one and of the other, all as normal distributions."""
    found, start = fit.x[:3], fit.problem.start[:3]
    wet = RATE_ROWS.T @ RATE_ROWS
    posterior = np.linalg.inv(attenuation_covariance(fit))
    values, vectors = np.linalg.eigh(posterior - wet)
    seen = (vectors * np.maximum(values, LEAST_INFORMATION)) @ vectors.T
    middle = np.linalg.solve(seen, posterior @ found - wet @ start)
    clear = np.full(3, np.log(OPTICAL_DEPTH / fit.problem.median_range))
    spread = np.linalg.inv(seen)
    dry, water = np.linalg.inv(ROWS.T @ ROWS), np.linalg.inv(wet)
    return _log_normal(middle - clear, spread + dry) - _log_normal(middle - start, spread + water)


def attenuation_covariance(
    fit: WaterFit,  # with water
) -> Array:
    """[3, 3] of log beta_a: by the observations' errors, and by CONTRAST_SIGMA."""
    depth = np.maximum(np.exp(fit.x[:3]) * fit.problem.median_range, LEAST_DEPTH)
    alike = CONTRAST_SIGMA / depth
    return np.asarray(fit.repeated_covariance[:3, :3] + np.outer(alike, alike))


def _log_normal(
    off: Array,  # [K]
    covariance: Array,  # [K, K]
) -> float:
    """Log density up to the constant that all normal distributions in K dimensions share."""
    return float(-0.5 * (off @ np.linalg.solve(covariance, off) + np.linalg.slogdet(covariance)[1]))


# --------------------------------------------------------------------------------------------------
# Which of shading, exposure and unevenness there are: the likeliest model with and without water.
#
# Only the richest models are fitted from the start. What a smaller one's marginal likelihood is
# follows from a richer one's posterior, taken as a normal distribution: the density of the parts
# left out at nothing, before and after the observations (Savage and Dickey's ratio). The likeliest
# is then fitted itself.

NOISE = 0.005
"""Least colour noise of one observation, the mean over a patch."""
FIRST_NOISE = 0.03
"""In the first fit, which is yet to find the noise."""
FEWEST_REPEATS, MOST_REPEATS = 1.0, 100.0
"""Bounds of how often the same error is counted (solver.py)."""


def fit_likeliest(problems: Sequence[WaterModel]) -> Generator[None, None, list[WaterFit]]:
    """Of those with water and those without the likeliest each; pauses every few milliseconds.

    The richest model comes first: it says how large the errors are, and where the others start.
    """
    richest = max(problems, key=lambda problem: problem.size)
    first = yield from descend(richest, richest.start, FIRST_NOISE)
    noise = max(first.spread(), NOISE)
    first = yield from descend(richest, first.x, noise)
    repeats = min(max(first.repetition(), FEWEST_REPEATS), MOST_REPEATS)
    noise *= float(np.sqrt(repeats))
    chosen = []
    for water in (False, True):
        some = [problem for problem in problems if problem.model.water is water]
        if some:
            chosen.append((yield from _likeliest(some, first, noise)))
    return chosen


def _likeliest(
    problems: Sequence[WaterModel],
    first: WaterFit,
    noise: float,
) -> Generator[None, None, WaterFit]:
    """The likeliest of the problems, fitted."""
    best: tuple[float, WaterModel, Array] | None = None
    for rich in _richest(problems):
        fit = yield from descend(rich, rich.adopt(first.problem, first.x), noise)
        for problem in problems:
            if _contains(rich, problem):
                candidate = without(fit, problem)
                best = candidate if best is None or candidate[0] > best[0] else best
        yield
    assert best is not None
    _, problem, x = best
    # One channel may be stuck where its backscatter grows at once: tried from two sides.
    last = []
    for start in (x, problem.start):
        last.append((yield from descend(problem, start, noise)))
    return max(last, key=lambda fit: fit.log_evidence)


def _richest(problems: Sequence[WaterModel]) -> Iterator[WaterModel]:
    """Those that no other contains."""
    for problem in problems:
        if not any(other is not problem and _contains(other, problem) for other in problems):
            yield problem


def _contains(rich: WaterModel, poor: WaterModel) -> bool:
    pairs = zip(astuple(poor.model), astuple(rich.model), strict=True)
    return all(has <= may for has, may in pairs)


def without(fit: WaterFit, problem: WaterModel) -> tuple[float, WaterModel, Array]:
    """Log evidence of a smaller problem by a richer one's fit, and its parameters then."""
    kept = np.zeros(fit.problem.size, bool)
    for mine, theirs in zip(problem.parts, fit.problem.parts, strict=True):
        kept[theirs] = mine.stop > mine.start
    left_out = ~kept
    if not left_out.any():
        return fit.log_evidence, problem, fit.x
    _, rows = fit.problem.priors(fit.x)
    # What is left out has a prior of its own, of mean zero.
    prior = (rows.T @ rows)[np.ix_(left_out, left_out)]
    covariance = fit.covariance
    block = covariance[np.ix_(left_out, left_out)]
    off = fit.x[left_out]
    pull = np.linalg.solve(block, off)
    log_ratio = -0.5 * (off @ pull + np.linalg.slogdet(block)[1] + np.linalg.slogdet(prior)[1])
    x = fit.x[kept] - covariance[np.ix_(kept, left_out)] @ pull
    return fit.log_evidence + float(log_ratio), problem, x


# --------------------------------------------------------------------------------------------------
# Least squares for the water: robust cost, normal equations, and what the fit leaves unknown.

KERNEL = SoftL1()
"""Of an observation's error in one channel."""
STEPS_AT_ONCE, MOST_ROUNDS = 5, 10
"""Iterations between two pauses, each takes 3 to 6 ms; and how often in one fit at most."""
LEAST_GAIN = 1e-5
"""Relative fall of the cost at which a fit has converged."""
TINY = 1e-12
"""Guards a division where the observations say nothing at all."""
FIRST_DAMPING = 1e-3
"""Relative to the diagonal: rates and colours start far from the minimum."""


@dataclass(frozen=True)
class WaterFit:
    """The best parameters of one model, at a stated noise of the observations."""

    problem: WaterModel
    x: Array
    """[K]"""
    noise: float
    weight: Array
    """[3, M] of the observations, by their errors."""

    @cached_property
    def prediction(self) -> Prediction:
        """The observations through the fitted water."""
        return self.problem.predict(self.x, self.weight)

    @cached_property
    def information(self) -> Array:
        """[K, K] inverse covariance of the parameters; exact where the cost is a square."""
        return normal_equations(self.problem, self.x, self.prediction, self.weight)[0]

    @cached_property
    def covariance(self) -> Array:
        """[K, K]"""
        return np.asarray(np.linalg.pinv(self.information, hermitian=True))

    @cached_property
    def repeated_covariance(self) -> Array:
        """[K, K] by errors as alike as this very model's are; the richest stated the noise."""
        return max(self.repetition(), 1.0) * self.covariance

    @cached_property
    def log_evidence(self) -> float:
        """Log of the marginal likelihood (Laplace), but for what all models here share."""
        _, rows = self.problem.priors(self.x)
        prior, posterior = (np.linalg.slogdet(H)[1] for H in (rows.T @ rows, self.information))
        found = cost(self.problem, self.x, self.prediction, self.noise)
        return float(0.5 * (prior - posterior - found))

    def spread(self) -> float:
        """Standard deviation of an observation's error, outliers left out."""
        return sigma_of(self.prediction.errors)

    def repetition(self) -> float:
        """How often the same error is counted: neighbouring points share the light that plays on
        them, the three channels too, and the observations of a point its own.

        The variance that the gradients of whole regions show over the one that they would have,
        if each observation's error were its own, in the directions that the fit leaves unknown.
        """
        first = self.problem.exposure.start
        shared = self.problem.seen.errors_shared
        expected, scores = np.zeros((first, first)), np.zeros((first, int(shared.max()) + 1))
        for c in range(3):
            found = self.problem.derivatives(self.prediction, self.weight[c], c)
            own = found.own[: len(found.direct)]
            weighed = found.direct * self.weight[c]
            by_J = found.by_J[: len(own)]
            each = self.problem.seen.sums_by_point(weighed * self.prediction.a[c])
            expected[np.ix_(own, own)] += weighed @ found.direct.T + by_J @ each.T
            for k, row in zip(own, weighed * self.prediction.errors[c], strict=True):
                scores[k] += np.bincount(shared, row, scores.shape[1])
        covariance = self.covariance[:first, :first]
        alone = max(float((covariance * expected).sum()), TINY)
        return float((covariance * (scores @ scores.T)).sum()) / alone


def descend(
    problem: WaterModel,
    x: Array,  # [K] parameters
    noise: float,
) -> Generator[None, None, WaterFit]:
    """The parameters of least robust cost; pauses every few iterations."""
    descent = _Descent(problem, noise)
    rules = Rules(STEPS_AT_ONCE, decrease=LEAST_GAIN, damping=FIRST_DAMPING)
    for _ in range(MOST_ROUNDS if problem.size else 0):
        found = minimise(descent, x, rules)
        x, rules = found.state, replace(rules, damping=found.damping)
        yield
        if found.ending is not Ending.EXHAUSTED:
            break
    weight = descent.reweigh(x)
    return WaterFit(descent.problem, x, noise, weight)


class _Descent:
    """The water as a problem of least squares; its priors and weights follow the parameters."""

    def __init__(self, problem: WaterModel, noise: float) -> None:
        self.problem, self._noise = problem, noise
        self._weight: Array | None = None
        self._last: tuple[Array, Prediction] | None = None

    def reweigh(
        self,
        x: Array,  # [K]
    ) -> Array:
        """[3, M] the weights that go with ``x``; they are taken from now on, as its priors are."""
        before = self._predict(x)
        self.problem, self._last = self.problem.expecting(x), None
        self._weight = weights(self.problem, before, self._noise)
        return self._weight

    def linearise(
        self,
        x: Array,  # [K]
    ) -> NormalEquations:
        """The equations of a step [K], by new weights."""
        weight = self.reweigh(x)
        H, gradient = normal_equations(self.problem, x, self._predict(x), weight)
        return NormalEquations(H, gradient, self.cost(x))

    def cost(
        self,
        x: Array,  # [K]
    ) -> float:
        """Half the robust cost."""
        return 0.5 * cost(self.problem, x, self._predict(x), self._noise)

    def move(
        self,
        x: Array,  # [K]
        step: Array,  # [K]
    ) -> Array:
        """Their sum."""
        return x + step

    def _predict(
        self,
        x: Array,  # [K]
    ) -> Prediction:
        if self._last is None or self._last[0] is not x:
            self._last = x, self.problem.predict(x, self._weight)
        return self._last[1]


def cost(
    problem: WaterModel,
    x: Array,  # [K] parameters
    now: Prediction,
    noise: float,
) -> float:
    """Soft L1 of the observations' whitened errors and squares of the priors', together."""
    total = float((problem.priors(x)[0] ** 2).sum())
    whitened = now.errors / (noise * problem.seen.error_scale)
    total += float(2.0 * KERNEL.cost(whitened).sum())
    return total + float((problem.of_scene(now.J) ** 2).sum())


def normal_equations(
    problem: WaterModel,
    x: Array,  # [K] parameters
    now: Prediction,
    weight: Array,  # [3, M]
) -> tuple[Array, Array]:
    """J^T W J and J^T W r of the same cost, the points' colours eliminated."""
    residuals, rows = problem.priors(x)
    H, g = rows.T @ rows, rows.T @ residuals
    changes = []
    for c in range(3):
        found = problem.derivatives(now, weight[c], c)
        block, slope = _of_channel(problem, found, now, weight[c], c)
        H[np.ix_(found.own, found.own)] += block
        g[found.own] += slope
        changes.append((found.own, found.by_J))
    scene = problem.of_scene_rows(now.J, changes)
    return H + scene.T @ scene, g + scene.T @ problem.of_scene(now.J)


def _of_channel(
    problem: WaterModel,
    found: Derivatives,
    now: Prediction,
    w: Array,  # [M] weights
    c: int,
) -> tuple[Array, Array]:
    """[k, k] and [k]: one channel's share of both, by its own parameters."""
    seen, errors = problem.seen, now.errors[c]
    weighed, k = found.direct * w, len(found.direct)
    H = np.zeros((len(found.own), len(found.own)))
    H[:k, :k] = weighed @ found.direct.T
    g = np.concatenate([weighed @ errors, np.zeros(len(found.own) - k)])
    if problem.model.exposure:
        views = problem.views
        by_view = [np.bincount(seen.view, row * found.lit, views) for row in weighed]
        alone = np.diag(np.bincount(seen.view, w * found.lit**2, views))
        slope = np.bincount(seen.view, w * found.lit * errors, views)
        # Only what differs from the mean gain has an effect.
        if k:
            cross = np.stack(by_view)
            H[:k, k:] = cross - cross.mean(axis=1, keepdims=True)
            H[k:, :k] = H[:k, k:].T
        alone = alone - alone.mean(axis=0)
        H[k:, k:] = alone - alone.mean(axis=1, keepdims=True)
        g[k:] = slope - slope.mean()
    # sum w (d + a dJ)^2 = sum w d^2 - power dJ^2, as dJ is the best there is.
    H -= (found.by_J * now.power[c]) @ found.by_J.T
    g += found.by_J @ seen.sums_by_point(w * now.a[c] * errors)
    return H, g


def weights(problem: WaterModel, now: Prediction, noise: float) -> Array:
    """[3, M] of the observations, those of soft L1."""
    sigma = noise * problem.seen.error_scale
    return np.asarray(KERNEL.weight(now.errors / sigma) / sigma**2)
