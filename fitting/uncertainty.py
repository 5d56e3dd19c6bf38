"""Error bars: what the images determine, how well, and what they do not.

Around the optimum the whitened residuals are linear in the coordinates y, so the covariance of y is (JᵀJ)⁻¹ =
(RᵀR)⁻¹, with R from the last step of the solution; that of the physical numbers q(y) is G (JᵀJ)⁻¹ Gᵀ with G = dq/dy
(the delta method). This linear algebra is a few numbers only and is done in float64 on the host, on columns scaled to
length one.

To this is added what errors of the model itself do to the parameters (:attr:`fitting.solve.Solution.model_error`). They are
not noise: no number of pixels averages them out, and in a good image they are the larger part.

A combination of coordinates that changes no residual beyond rounding is not determined: it is left out of the
inverse, and every number that would move along it gets no standard error at all.

Standard errors are multiplied by √(reduced χ²) where that exceeds one, as the Particle Data Group does: if the
residuals are larger than the stated noise, either the noise is understated or the model does not describe the image,
and neither leaves room for more confidence. What is known beforehand stays as it is, and so the fit has weighed the images
against it with the noise that they show (:attr:`fitting.problem.Problem.understated`).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo.atmosphere import Atmosphere
from diffatmo.compiling import outermost
from diffatmo.models import Model, Moments
from diffatmo.numerics import array
from fitting._errors import FitError
from fitting.elimination import RANK_TOLERANCE
from fitting.findings import Estimate, Minimum, Setup
from fitting.nuisances import Nuisances, assumed
from fitting.observation import UNNAMED, Observation, unstack
from fitting.parameters import Coordinates, Parameters
from fitting.priors import Prior
from fitting.quantities import numbers, quantities
from fitting.result import FitResult
from fitting.search import Progress
from fitting.solve import MAX_STEPS, TOLERANCE, Solution, solve

T = TypeVar("T")


def propagate(
    factor: Float[np.ndarray, "n n"], gradient: Float[np.ndarray, "q n"]
) -> tuple[Float[np.ndarray, "q q"], np.ndarray]:
    """Covariance G (RᵀR)⁻¹ Gᵀ from ``factor`` R and ``gradient`` G, and which of the numbers are determined at all.

    Rows and columns of the others are NaN.
    """
    length = np.linalg.norm(factor, axis=0)
    scale = np.where(length > 0, length, 1)
    _, singular, right = np.linalg.svd(factor / scale)
    seen = singular > RANK_TOLERANCE * max(singular.max(), 1e-300)
    scaled = gradient / scale
    size = np.linalg.norm(scaled, axis=1)
    # A number that moves along an unseen direction by more than rounding is not determined.
    unseen = np.linalg.norm(scaled @ right[~seen].T, axis=1)
    determined = unseen <= 1e-3 * np.where(size > 0, size, 1)
    half = scaled @ right[seen].T / singular[seen]
    covariance = half @ half.T
    covariance[~determined] = np.nan
    covariance[:, ~determined] = np.nan
    return covariance, determined


def data_shares(
    of_images: Float[np.ndarray, "n n"], factor: Float[np.ndarray, "n n"], gradient: Float[np.ndarray, "q n"]
) -> list[float]:
    """The part of each number's precision that comes from the images, from 0 (all is prior) to 1.

    With the covariance C = (F_images + F_priors)⁻¹, the variance of a number with gradient g is gᵀCg = gᵀC (F_images +
    F_priors) Cg, and the first term is the images' part: the averaging kernel of retrievals (Rodgers 2000, eq. 2.78).
    """
    length = np.linalg.norm(factor, axis=0)
    unit = np.where(length > 0, length, 1)
    inverse = np.linalg.pinv(factor / unit, rcond=RANK_TOLERANCE) / unit[:, None]
    half = gradient @ inverse
    along = np.linalg.norm(half @ inverse.T @ of_images.T, axis=1)
    whole = np.linalg.norm(half, axis=1)
    return [float(np.clip((a / w) ** 2, 0, 1)) if w > 0 else 0.0 for a, w in zip(along, whole, strict=True)]


def _physical(
    y: Coordinates, parameters: Parameters, nuisances: Nuisances
) -> tuple[Float[Array, " q"], tuple[Float[Array, " q"], Atmosphere]]:
    """The numbers that are reported, once to be differentiated and once for themselves, and the atmosphere."""
    atmosphere = parameters.atmosphere(y[: parameters.size])
    found = numbers(atmosphere, [*parameters.fields, *parameters.derived])
    values = jnp.concatenate([found, nuisances.values(y[parameters.size :])])
    return values, (values, atmosphere)


def _slopes(y: Coordinates, parameters: Parameters, nuisances: Nuisances) -> Any:
    return jax.jacfwd(_physical, has_aux=True)(y, parameters, nuisances)


def summarise(
    solution: Solution,
    observations: Sequence[Observation],
    model: Model,
    *,
    priors: Sequence[Prior] = (),
    refine: bool,
    free: Sequence[str] = (),
    tie: Mapping[str, str] | None = None,
    loss: str | None = None,
) -> FitResult:
    """Attach error bars to ``solution``, which was found with ``model``, and its finer self if ``refine``."""
    parameters = solution.parameters
    count = parameters.size
    wavelengths = [float(nm) for nm in parameters.init.wavelengths]
    fields, derived = parameters.fields, parameters.derived
    fitted_quantities = quantities(fields, wavelengths)
    all_quantities = fitted_quantities + quantities(derived, wavelengths)

    slopes, (numbers_found, atmosphere) = outermost(_slopes)(solution.y, parameters, solution.batch.nuisances)
    values, gradient = np.asarray(numbers_found, dtype=float), np.asarray(slopes, dtype=float)
    of_images = solution.of_images[:-1, :-1] / solution.error_scale
    factor = np.asarray(np.linalg.qr(np.vstack([of_images, solution.of_priors]), mode="r"))
    covariance, determined = propagate(factor, gradient)
    shares = data_shares(of_images, factor, gradient)
    covariance = covariance + gradient @ solution.model_error @ gradient.T
    errors = [math.sqrt(v) if ok else None for v, ok in zip(np.diag(covariance), determined, strict=True)]
    start = np.concatenate([parameters.start, np.zeros(solution.y.size - count)])
    initial = np.asarray(
        outermost(_slopes)(array(start, solution.y.dtype), parameters, solution.batch.nuisances)[1][0], dtype=float
    )
    at_bound = parameters.at_bound(np.asarray(solution.y)[:count])

    estimates = [
        Estimate(
            name=quantity.name,
            field=quantity.field,
            wavelength=quantity.wavelength,
            unit=quantity.unit,
            value=float(values[i]),
            standard_error=errors[i],
            initial=float(initial[i]),
            derived=i >= len(fitted_quantities),
            at_bound=i < len(fitted_quantities) and bool(at_bound[i]),
            data_share=shares[i] if determined[i] else None,
        )
        for i, quantity in enumerate(all_quantities)
    ]
    nuisances = [
        Estimate(
            name=label.name,
            field=label.name,
            wavelength=None,
            unit=label.unit,
            value=float(values[i]),
            standard_error=errors[i],
            initial=None,
            data_share=shares[i] if determined[i] else None,
        )
        for i, label in enumerate(solution.nuisances, start=len(all_quantities))
    ]
    return FitResult(
        atmosphere=atmosphere,
        parameters=estimates,
        nuisances=nuisances,
        covariance=covariance,
        covariance_names=[estimate.name for estimate in [*estimates, *nuisances]],
        chi2=solution.chi2,
        degrees_of_freedom=solution.degrees_of_freedom,
        error_scale=solution.error_scale,
        iterations=len(solution.history),
        converged=solution.converged,
        message=solution.message,
        history=solution.history,
        timings=solution.timings,
        observations=list(observations),
        fitted=[unstack(o, image) for o, image in zip(observations, solution.predicted, strict=True)],
        priors=[*priors, *(Prior(*known) for known in assumed(observations))],
        outliers=solution.outliers,
        minima=_minima(solution),
        moved=solution.moved,
        setup=Setup(parameters.init, list(free), dict(tie or {}), loss, np.asarray(solution.y)),
        undetermined=[e.name for e in [*estimates, *nuisances] if e.standard_error is None],
        model=model,
        refine=refine,
    )


def _listed(given: T | Iterable[T], kind: type[T], name: str, expected: str) -> list[T]:
    """What may be given alone, or several of them, as a list."""
    found = list(given) if isinstance(given, Iterable) and not isinstance(given, kind) else [given]
    for one in found:
        if not isinstance(one, kind):
            raise FitError(f"{name}: got {type(one).__name__}, expected {expected}")
    return found


def _numbered(observations: Sequence[Observation]) -> list[Observation]:
    """Those that were given no name have their number for one, where there are several."""
    unnamed = sum(o.name == UNNAMED for o in observations) > 1
    return [
        replace(o, name=f"{UNNAMED}_{number}") if unnamed and o.name == UNNAMED else o
        for number, o in enumerate(observations, start=1)
    ]


def _minima(solution: Solution) -> list[Minimum]:
    """The minima of the solution in the numbers that are reported."""
    parameters = solution.parameters
    names = [
        q.name
        for q in quantities([*parameters.fields, *parameters.derived], np.asarray(parameters.init.wavelengths).tolist())
    ]
    found = [outermost(_physical)(y, parameters, solution.batch.nuisances)[0] for y, _ in solution.minima]
    return [
        Minimum(dict(zip(names, np.asarray(values, float).tolist(), strict=False)), chi2)
        for values, (_, chi2) in zip(found, solution.minima, strict=True)
    ]


def fit(
    observations: Observation | Sequence[Observation],
    *,
    init: Atmosphere,
    free: Sequence[str],
    tie: Mapping[str, str] | None = None,
    priors: Prior | Sequence[Prior] = (),
    loss: str | None = None,
    model: Model | None = None,
    progress: Progress | None = None,
    max_steps: int = MAX_STEPS,
    tolerance: float = TOLERANCE,
    refine: bool = True,
    starts: int | None = None,
    checkpoint: str | Path | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> FitResult:
    """Recover an atmosphere's parameters from images of its sky, with error bars.

    Args:
        observations: One or several, from :func:`fitting.observe`; all are explained by the one atmosphere.
        init: Where the search starts, and the value of everything that is not free.
        free: Names of the fields of :class:`~diffatmo.atmosphere.Atmosphere` to recover; a spectral field is free at
            every wavelength.
        tie: How the wavelengths of a spectral field hang together, name -> kind: ``start`` (a common factor times the
            values of ``init``), ``grey``, ``lambda^-4`` (of ``rayleigh_scattering``), ``dobson`` (of ``ozone_absorption``), or
            ``{"mie": "angstrom"}``; see :mod:`fitting.parameters`.
        priors: What is known beforehand (:mod:`fitting.priors`), one or several.
        loss: None for least squares; ``huber``, ``cauchy`` or ``tukey`` where clouds or objects are in the picture
            (:mod:`fitting.robust`).
        model: How the sky is computed, :class:`~diffatmo.models.moments.Moments` by default.
        progress: Called after each step.
        max_steps: Evaluations of the model with its derivatives before the fit gives up; each further start has as many.
        tolerance: Distance to the optimum, in standard errors, at which it is found.
        refine: Whether the last steps explain the images by the model's ``finer`` self, if it has one, and the error bars
            take in what that may leave of the model's error. False fits images that ``model`` itself has made.
        starts: From how many starts to search: that of ``init``, and the best of a coarse grid about it
            (:mod:`fitting.starts`). None is one, and up to three more if its search ends at a reduced χ² above 2 or is still
            there after 40 steps. Several distinct minima, if there are, are in ``minima``.
        checkpoint: A file that holds the best point after every step, and from which the same fit goes on if it exists. It
            is left for the caller to remove.
        devices: Those that share out the pixels, ``jax.devices()`` by default: all of this machine, or of all processes of
            ``jax.distributed``, each of which has to make the same call.

    Returns:
        The best point found; ``converged`` and ``message`` say whether it is the optimum and why the fit stopped.

    Raises:
        FitError: The fit cannot be started: a name that is not a parameter, images that do not go together, a model
            that is not finite at the start.
    """
    model = Moments() if model is None else model
    observations = _numbered(
        _listed(observations, Observation, "observations", "fitting.observe(...), or a list of them")
    )
    priors = _listed(priors, Prior, "priors", "fitting.Prior(name, value, error), or a list of them")
    if not isinstance(checkpoint, str | Path | None):
        raise FitError(f"checkpoint: got {checkpoint!r}, expected the path of a file")
    free = free if isinstance(free, str) else _listed(free, str, "free", "a list of names of parameters")
    solution = solve(
        observations,
        init=init,
        free=free,
        tie=tie,
        priors=priors,
        loss=loss,
        model=model,
        progress=progress,
        max_steps=max_steps,
        tolerance=tolerance,
        refine=refine,
        starts=starts,
        checkpoint=None if checkpoint is None else Path(checkpoint),
        devices=devices,
    )
    return summarise(solution, observations, model, priors=priors, refine=refine, free=free, tie=tie, loss=loss)
