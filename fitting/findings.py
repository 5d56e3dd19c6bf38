"""What a fit found, as numbers: every estimate with its error bar, their covariance, and the images with their residuals.

:class:`Findings` is what everything that shows, stores or uses a fit is given; :class:`fitting.FitResult`, which the user
holds, is the same with those uses as its methods.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from statistics import NormalDist
from typing import Self

import numpy as np
from jaxtyping import Bool, Float

from diffatmo._names import did_you_mean
from diffatmo.atmosphere import Atmosphere
from diffatmo.models import Model
from fitting._errors import FitError
from fitting.nuisances import channel_names, group_of
from fitting.observation import Observation, sigma
from fitting.priors import Prior
from fitting.quantities import numbers
from fitting.search import Step

ONE_SIGMA, NINETY_FIVE = 0.6827, 0.95
"""Probabilities of intervals."""

DIFFERENT = 0.1
"""Part of its width by which an interval differs from another."""


@dataclass(frozen=True)
class Estimate:
    """A number with its error bar; ``standard_error`` is None where the images do not determine it.

    ``field`` and ``wavelength`` (nm) say what ``name`` stands for; ``derived`` marks combinations of fitted numbers,
    and ``at_bound`` values held by the edge of their range, whose error bar only tells how sharp the edge is
    approached.
    """

    name: str
    field: str
    wavelength: float | None
    unit: str
    value: float
    standard_error: float | None
    initial: float | None
    truth: float | None = None
    derived: bool = False
    at_bound: bool = False
    data_share: float | None = None
    """The part of its precision that comes from the images, not from priors."""

    @property
    def pull(self) -> float | None:
        """(value - truth) / standard error."""
        if self.truth is None or not self.standard_error:
            return None
        return (self.value - self.truth) / self.standard_error


@dataclass(frozen=True)
class Minimum:
    """One of several minima: its numbers, and its χ²."""

    values: dict[str, float]
    chi2: float


@dataclass(frozen=True)
class Setup:
    """What was asked for, which it takes to fit again, and the coordinates that were found (:mod:`fitting.parameters`)."""

    init: Atmosphere
    free: list[str]
    tie: dict[str, str]
    loss: str | None
    coordinates: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Profile:
    """Δχ² of one number against its value, everything else fitted again; see :mod:`fitting.profiles`."""

    name: str
    unit: str
    value: float
    standard_error: float | None
    points: Float[np.ndarray, " p"]
    """Values of the number, in increasing order."""
    delta_chi2: Float[np.ndarray, " p"]
    """χ² there above the least, in the unit of the error bars."""
    settled: Bool[np.ndarray, " p"]
    """Whether the search of everything else converged."""
    bounded: Sequence[bool]
    """Whether the first and the last point are where the range of the number ends."""

    def interval(self, level: float = ONE_SIGMA) -> tuple[float | None, float | None]:
        """The ends of the interval that holds the number with the probability ``level``; None where it is open.

        The root of Δχ², with the sign of the side, is taken to be linear between the points: exact for a parabola.
        """
        height = NormalDist().inv_cdf((1 + level) / 2)
        least = int(np.argmin(self.delta_chi2))
        root = np.sqrt(np.maximum(self.delta_chi2, 0))
        ends: list[float | None] = []
        for side, bounded in ((slice(least, None, -1), self.bounded[0]), (slice(least, None), self.bounded[1])):
            points, heights = self.points[side], root[side]
            beyond = np.flatnonzero(heights >= height)
            if beyond.size:
                last = int(beyond[0])
                part = (height - heights[last - 1]) / (heights[last] - heights[last - 1])
                ends.append(float(points[last - 1] + part * (points[last] - points[last - 1])))
            else:
                ends.append(float(points[-1]) if bounded else None)
        return ends[0], ends[1]

    @property
    def differs(self) -> bool:
        """Whether an end of either interval is off that of the covariance by more than a tenth of the standard error."""
        if self.standard_error is None:
            return True
        for level in (ONE_SIGMA, NINETY_FIVE):
            width = NormalDist().inv_cdf((1 + level) / 2) * self.standard_error
            for end, sign in zip(self.interval(level), (-1, 1), strict=True):
                if end is None or abs(end - self.value - sign * width) > DIFFERENT * width:
                    return True
        return False


@dataclass(frozen=True)
class Findings:
    """What a fit found. Arrays are NumPy's; ``covariance`` belongs to the numbers named in ``covariance_names``.

    Covariances of numbers that the images do not determine are NaN. ``fitted`` are the expected images in the units
    of the measured ones (NaN outside the fitted region), ``observations`` the images as they were fitted. ``model`` is the one
    that was fitted, None if it is not known any more; ``refine`` says that its finer self had the last word.
    """

    atmosphere: Atmosphere
    parameters: list[Estimate]
    nuisances: list[Estimate]
    covariance: Float[np.ndarray, "q q"]
    covariance_names: list[str]
    chi2: float
    degrees_of_freedom: int
    error_scale: float
    iterations: int
    converged: bool
    message: str
    history: list[Step]
    timings: dict[str, float]
    observations: list[Observation]
    fitted: list[Float[np.ndarray, "height width w"]]
    undetermined: list[str] = field(default_factory=list)
    priors: list[Prior] = field(default_factory=list)
    outliers: list[int] = field(default_factory=list)
    """Pixels of each image to which a robust loss gave less than half their weight."""
    minima: list[Minimum] = field(default_factory=list)
    """The distinct minima that were found, if there are several: the best first, all before any correction by a finer model."""
    profiles: list[Profile] = field(default_factory=list)
    """Of the numbers for which they were asked for (:func:`fitting.profile`)."""
    setup: Setup | None = None
    model: Model | None = None
    refine: bool = True
    moved: float = 0.0
    """By how many of its standard errors a finer model has moved the number that it moved most."""

    @property
    def reduced_chi2(self) -> float:
        """χ² per degree of freedom: 1 if the model and the stated noise explain the images."""
        return self.chi2 / max(self.degrees_of_freedom, 1)

    @property
    def correlation(self) -> Float[np.ndarray, "q q"]:
        """Correlation matrix of the numbers named in ``covariance_names``; NaN for those without an error."""
        return correlation(self.covariance)

    @property
    def fitted_correlation(self) -> tuple[list[str], Float[np.ndarray, "n n"]]:
        """Names and correlation matrix of the fitted numbers, without those that follow from them."""
        derived = {estimate.name for estimate in self.parameters if estimate.derived}
        kept = [number for number, name in enumerate(self.covariance_names) if name not in derived]
        return [self.covariance_names[number] for number in kept], self.correlation[np.ix_(kept, kept)]

    @property
    def residuals(self) -> list[Float[np.ndarray, "height width w"]]:
        """measured / fitted - 1 of each image, NaN where a pixel was not used."""
        result = []
        for observation, image in zip(self.observations, self.fitted, strict=True):
            known = observation.used[..., None] & (image > 0)
            result.append(np.where(known, observation.image / np.where(known, image, 1) - 1, np.nan).astype(np.float32))
        return result

    @property
    def noise(self) -> list[Float[np.ndarray, "height width w"]]:
        """The stated sigma of each image, of the light that was fitted; NaN where a pixel was not used."""
        result = []
        for observation, image in zip(self.observations, self.fitted, strict=True):
            noise = np.asarray(sigma(observation, image - self.pedestal(observation)))
            result.append(np.where(observation.used[..., None], noise, np.nan))
        return result

    @property
    def whitened(self) -> list[Float[np.ndarray, "height width w"]]:
        """(measured - fitted) / sigma of each image, NaN where a pixel was not used."""
        return [
            ((observation.image - image) / noise).astype(np.float32)
            for observation, image, noise in zip(self.observations, self.fitted, self.noise, strict=True)
        ]

    def pedestal(self, observation: Observation) -> Float[np.ndarray, " w"]:
        """What was added to the light of an image that was fitted, for each channel."""
        names = channel_names(observation, "pedestal", [float(nm) for nm in self.atmosphere.wavelengths])
        return np.array([0.0 if name is None else self.estimate(name).value for name in names])

    def exposure(self, observation: Observation) -> Float[np.ndarray, " w"]:
        """What the radiance of an image that was fitted was multiplied by, for each channel: exposure and white balance."""
        wavelengths = [float(nm) for nm in self.atmosphere.wavelengths]
        factors = [
            [
                1.0 if name is None else self.estimate(name).value
                for name in channel_names(observation, kind, wavelengths)
            ]
            for kind in ("exposure", "white_balance")
        ]
        return observation.exposure_value * np.prod(factors, axis=0)

    def saturation(self, observation: Observation) -> float:
        """Coefficient of the purity of its colours; 0 where that is fixed."""
        group = group_of(observation, "chroma")
        return 0.0 if group is None else self.estimate(f"chroma_{group}_saturation").value

    @property
    def estimates(self) -> list[Estimate]:
        """Parameters, derived quantities and nuisances, in the order of the covariance."""
        return [*self.parameters, *self.nuisances]

    def estimate(self, name: str) -> Estimate:
        """The parameter, derived quantity or nuisance called ``name``; raises KeyError for any other."""
        for estimate in self.estimates:
            if estimate.name == name:
                return estimate
        names = [estimate.name for estimate in self.estimates]
        hint = did_you_mean(name, names) or ";"
        raise KeyError(f"{name!r} is no number of this fit{hint} numbers are {', '.join(names)}")

    def with_truth(self, truth: Atmosphere) -> Self:
        """The same with the true value beside each parameter; raises :class:`FitError` for other wavelengths."""
        own = np.asarray(self.atmosphere.wavelengths)
        if truth.wavelengths.shape != own.shape or not np.allclose(truth.wavelengths, own):
            raise FitError(f"truth: has wavelengths {truth.wavelengths.tolist()}, the fit {own.tolist()}")
        fields = list(dict.fromkeys(estimate.field for estimate in self.parameters))
        values = np.asarray(numbers(truth, fields), dtype=float)
        return replace(
            self, parameters=[replace(e, truth=float(v)) for e, v in zip(self.parameters, values, strict=True)]
        )


def correlation(covariance: Float[np.ndarray, "q q"]) -> Float[np.ndarray, "q q"]:
    """Covariance divided by both standard deviations; NaN where a variance is zero or unknown."""
    deviation = np.sqrt(np.diag(covariance))
    deviation = np.where(deviation > 0, deviation, np.nan)
    return covariance / np.outer(deviation, deviation)
