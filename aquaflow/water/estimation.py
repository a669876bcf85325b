"""The water, the camera's shading and the views' exposures, from points seen at several ranges.

A point's colour J is unknown but the same from everywhere; what changes with range is the water:
the contrast between bright and dark points decays by exp(-beta z), and their common level moves
towards B_inf. Photometric gradients alone hardly move the water, because every Gaussian's colour
can follow its error.

Lamps and lenses darken the picture towards its edge, and near ground is seen near the edge: left
out, that looks like water. So does light that changes while the vehicle climbs. Sunlit water shines
more brightly the less one looks down. And in air or clear water there is nothing to find at all.
Which of the four are there is decided by the models' marginal likelihoods (Laplace's method) under
stated priors, with errors that neighbours share counted once (solver.py).

A dive is in water unless there is evidence for clear water, and the likeliest water would not show
(clear.py). Where little can be seen of it, the usual water is taken, with its uncertainty.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from aquaflow.config import MediumConfig, WaterPriorsConfig
from aquaflow.water.clear import attenuation_covariance, log_odds_clear
from aquaflow.water.model import BELIEVED, WaterModel
from aquaflow.water.nearest import Nearest, nearest_of, white_balance
from aquaflow.water.observations import Observations, variance_over_range
from aquaflow.water.open_sightings import with_open_water
from aquaflow.water.parameters import Model
from aquaflow.water.posed_picture import PosedPicture
from aquaflow.water.selection import fit_likeliest
from aquaflow.water.solver import WaterFit
from aquaflow.water.white_balance import WhiteBalance

Array = npt.NDArray[np.float64]

MIN_POINTS = 100
"""Fewer points say nothing about the water."""
WATER_IS_USUAL = 5.0
"""Log odds for water before anything is seen: one dive in 150 is in air or in water as clear."""
NEGLIGIBLE_DEPTH = 0.06
"""Optical depth at the median range up to which no eye sees water: as much as maps lose anyway
(clear.py)."""
VISIBLE_DEPTH = 0.12
"""Optical depth at the median range from which water shows: a ninth of the light is gone. Rendered
scenes without water look like 0.02 to 0.05."""
EVERY_MODEL = tuple(
    Model(*parts) for parts in product((False, True), repeat=4) if Model(*parts).is_possible
)
"""With and without each part. Shading and unevenness together only where open water is seen."""


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
    unevenness: Array
    """[5] coefficients of the backscatter's log-gain over the picture."""
    beta_a_sigma: list[float] | None
    """[3] relative standard deviation of beta_a; None without water."""
    shading: Array
    """[5] coefficients of the log-gain."""
    exposure: Array
    """[V, 3] log-gain of each view, of mean zero."""
    evidence: float | None
    """Log odds of water against clear water or none, WATER_IS_USUAL not counted; None: only one of
    the two was tried."""
    nearest: Nearest | None
    """What was seen nearest; None without water."""
    balance: WhiteBalance | None
    """What restored pictures are shown in; None without water."""
    range_variance: tuple[float, float]
    """Relative variance of the points' colours that follows from their range: as the camera saw
    them, and without water."""


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
    yield
    extended = yield from with_open_water(observations, pictures, wet.prediction.trial)
    if extended.points > observations.points:
        wet_models = [model for model in models if model.water]
        (wet,) = yield from fit_likeliest(problems(extended, wet_models))
    return (yield from _estimate(observations, wet, odds, pictures))


def _estimate(
    observations: Observations,
    best: WaterFit,
    odds: float | None,
    pictures: Sequence[PosedPicture] = (),
) -> Generator[None, None, WaterEstimate]:
    """What the fit, perhaps to open water too, says of the observations of the surface."""
    seen, trial, water = observations, best.prediction.trial, best.problem
    range_variance = [variance_over_range(seen, seen.colour)] * 2
    sigma = nearest = balance = None
    if water.model.water:
        sigma = _beta_a_sigma(best)
        J = best.prediction.J[:, : seen.points]
        nearest = yield from nearest_of(seen, pictures, trial)
        balance = white_balance(nearest, water, trial, J, sigma)
        clean = water.without_water(trial, seen.view, seen.xy, seen.z, seen.colour)
        range_variance[1] = variance_over_range(seen, clean.T)
    return WaterEstimate(
        water.model,
        trial.beta_a,
        trial.B_inf,
        trial.b,
        trial.unevenness,
        sigma,
        trial.shading,
        trial.exposure,
        odds,
        nearest,
        balance,
        (range_variance[0], range_variance[1]),
    )


def _is_clear(wet: WaterFit, odds: float) -> bool:
    """Clear needs evidence, and that the likeliest water would not show; water that takes next to
    nothing is as good as clear, however sure it is."""
    depth = float((np.exp(wet.x[:3]) * wet.problem.median_range).max())
    return depth < NEGLIGIBLE_DEPTH or (odds + WATER_IS_USUAL < 0.0 and depth < VISIBLE_DEPTH)


def log_odds_of_water(dry: WaterFit, wet: WaterFit) -> float:
    """Against a scene without any, and one that looks no more like water than clear scenes do."""
    return min(wet.log_evidence - dry.log_evidence, -log_odds_clear(wet))


def _beta_a_sigma(fit: WaterFit) -> list[float]:
    variance = np.maximum(np.diag(attenuation_covariance(fit)), 0.0)
    return list(np.sqrt(variance).tolist())
