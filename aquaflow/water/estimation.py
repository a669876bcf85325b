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
from itertools import product

import numpy as np
import numpy.typing as npt

from aquaflow.config import MediumConfig, WaterPriorsConfig
from aquaflow.water.fit import WaterFit, descend
from aquaflow.water.model import BELIEVED, RATE_ROWS, Model, WaterModel, rate_rows, with_lamp
from aquaflow.water.mounting import SHARE_ERROR, Lamp, places_of
from aquaflow.water.nearest import Nearest, nearest_of, white_balance
from aquaflow.water.normals import with_normals
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
LAMP_SHOWS = 20.0
"""Log odds for a lamp from which it is taken as seen: -28 to 5 by daylight, 59 to 133 on a rendered
survey by lamps from one height, 97 on an AUV's by its strobe, 240 to 2100 on ten rendered dives
with lamps (notes/2026-11-water.md#one-height)."""
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
        return (yield from _estimate(observations, dry, odds, np.zeros(3)))
    lamplit, doubt = with_lamp(some), np.zeros(3)
    if (yield from _may_have_lamp(wet, problems(observations, lamplit))):
        if observations.normal is None and pictures:
            observations = yield from with_normals(observations, pictures)
        wet, doubt = yield from _lamplit(wet, problems(observations, lamplit))
    yield
    found = wet.prediction
    extended = yield from with_open_water(observations, pictures, found.trial, found.J.mean(axis=1))
    if extended.points > observations.points:
        wet_models = [model for model in models if model.water]
        wet_models = with_lamp(wet_models) if wet.problem.model.lamp else wet_models
        (wet,) = yield from fit_likeliest(problems(extended, wet_models))
    return (yield from _estimate(observations, wet, odds, doubt, pictures))


def _estimate(
    observations: Observations,
    best: WaterFit,
    odds: float | None,
    doubt: Array,  # [3]
    pictures: Sequence[PosedPicture] = (),
) -> Generator[None, None, WaterEstimate]:
    """What the fit, perhaps to open water too, says of the observations of the surface; ``doubt``:
    how far log beta_a is from what a model says that is not ruled out."""
    shown = yield from _as_pictures_show(best)
    seen, trial, water = observations, shown.prediction.trial, best.problem
    range_variance = [variance_over_range(seen, seen.colour)] * 2
    sigma = nearest = balance = lightness = None
    if water.model.water:
        sigma = np.hypot(_beta_a_sigma(best), doubt).tolist()
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
        None if trial.lamp is None else _as_it_is_known(trial.lamp, best),
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


def _as_it_is_known(lamp: Lamp, lit: WaterFit) -> Lamp:
    """The lamp, with its deviations and its places by the fit that knows its mounting."""
    water = lit.problem
    covariance = lit.repeated_covariance[water.lamp, water.lamp]
    # The derivative of a share by its logit.
    share_sigma = lamp.share * (1.0 - lamp.share) * np.sqrt(max(covariance[0, 0], 0.0))
    known = replace(lamp, share_sigma=float(np.hypot(share_sigma, SHARE_ERROR)))
    if not water.knows_mounting:
        return known
    places, sigma = places_of(lit.x[water.lamp][2:], covariance[2:, 2:])
    mounted = replace(known, range=1.0, places=places, places_sigma=sigma)
    return replace(mounted.rescale(water.median_range), range=lamp.range)


def _may_have_lamp(wet: WaterFit, problems: Sequence[WaterModel]) -> Generator[None, None, bool]:
    """Whether the richest of the problems, all with a lamp, is likelier than ``wet``."""
    if not problems:
        return False
    richest = max(problems, key=lambda problem: problem.size)
    first = yield from descend(richest, richest.adopt(wet.problem, wet.x), wet.noise)
    return first.log_evidence > wet.log_evidence


def _lamplit(
    wet: WaterFit, problems: Sequence[WaterModel]
) -> Generator[None, None, tuple[WaterFit, Array]]:
    """The likeliest of the problems, all with a lamp, if that is far likelier than ``wet``; and how
    far [3] log beta_a is from that of one that is only somewhat likelier."""
    (lit,) = yield from fit_likeliest(problems)
    # Evidence is comparable at one noise only: that of the better fit.
    dark = yield from descend(wet.problem, wet.x, lit.noise)
    odds = lit.log_evidence - dark.log_evidence
    if odds > LAMP_SHOWS:
        return lit, np.zeros(3)
    return wet, np.abs(lit.x[:3] - wet.x[:3]) if odds > 0.0 else np.zeros(3)


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
    for start in (x, problem.start) if problem.model.water else (x,):
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
