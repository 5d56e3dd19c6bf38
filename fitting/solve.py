"""The solution of a fit by Levenberg-Marquardt, without its error bars.

Each step costs one evaluation of the model with its derivatives over all pixels, compiled once; it is reduced to the
triangular factor of [J r] (:func:`fitting.residuals.triangle`), in which optimistix then takes its step. As the loop over
steps runs in Python, progress can be shown, the time of a step is known, and an interrupt ends the fit at its best point.

*Convergence* is judged in units of the parameters' own uncertainty, as in MINUIT: the squared distance to the minimum,
(Jᵀr)ᵀ (JᵀJ)⁻¹ Jᵀr, says by how much χ² would still fall if the residuals were linear. Below 0.01 every parameter is within a
tenth of its standard error of the optimum. Parameters held by their bounds do not count.

*Noise.* sigma depends on the expected signal, which is known only after the fit. Taken from the noisy pixels it favours those
that came out dark, and biases the radiance by about -2 (relative noise)²: 2e-4 for 1 % noise, ten standard errors of a
well-determined parameter. So the fit has two passes: sigma from the measured signal first, then from the fitted one.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from diffatmo.atmosphere import Atmosphere
from diffatmo.models.base import Model
from fitting._errors import FitError
from fitting.observation import Batch, Observation, exposures, stack
from fitting.parameters import Coordinates, Parameters, select
from fitting.residuals import Predicted, Problem, linearise, triangle

TOLERANCE = 0.01
MAX_STEPS = 100

FIRST_PASS_TOLERANCE = 1.0
"""The first pass only has to find the sigma of the second: one standard error from its optimum is plenty."""

ROUNDING_DISTANCE = 0.1
"""Squared distance below which rejected steps mean that rounding hides the last of the way."""

REJECTIONS_AT_ROUNDING, REJECTIONS_AT_MOST = 3, 20

INTERRUPTED = "interrupted by the user"
OUT_OF_STEPS = "stopped: not converged in the steps allowed"

# The test for convergence is made here, so optimistix's own is set out of reach.
_SOLVER = optx.LevenbergMarquardt(rtol=1e-30, atol=1e-30)


class Step(NamedTuple):
    """One evaluation of the fit.

    ``chi2`` is that of the point tried (infinite where the model was), ``accepted`` whether it became the current one;
    ``change`` is the largest change of a coordinate that led to it (about the relative change of a parameter),
    ``distance`` the squared distance to the minimum from the current point, in standard errors.
    """

    step: int
    stage: int
    chi2: float
    reduced_chi2: float
    accepted: bool
    change: float
    distance: float
    damping: float
    seconds: float


Progress = Callable[[Step], Any]


class Solution(NamedTuple):
    """The best point found and the linear model around it."""

    parameters: Parameters
    batch: Batch
    exposure_names: list[str]
    y: Coordinates
    triangle: Float[np.ndarray, "n+1 n+1"]
    predicted: Float[np.ndarray, "image pixel w"]
    history: list[Step]
    residual_count: int
    converged: bool
    message: str
    timings: dict[str, float]

    @property
    def chi2(self) -> float:
        """Sum of the squared whitened residuals."""
        return float(np.sum(self.triangle[:, -1] ** 2))

    @property
    def degrees_of_freedom(self) -> int:
        """Number of residuals less number of coordinates."""
        return self.residual_count - self.y.size


@eqx.filter_jit
def _evaluate(y: Coordinates, problem: Problem) -> tuple[Predicted, Float[Array, "n+1 n+1"]]:
    expected, residual, jacobian = linearise(y, problem)
    return expected, triangle(residual, jacobian)


def _tangent_plane(y: Coordinates, plane: tuple[Array, Array, Array]) -> tuple[Array, None]:
    residual, jacobian, origin = plane
    # A sum, not a matrix product, which accelerators may run in reduced precision.
    return residual + jnp.sum(jacobian * (y - origin), axis=-1), None


@eqx.filter_jit
def _start(y: Coordinates) -> Any:
    n = y.size
    plane = (jnp.zeros(n + 1, y.dtype), jnp.zeros((n + 1, n), y.dtype), y)
    residual = jax.ShapeDtypeStruct((n + 1,), y.dtype)
    return _SOLVER.init(_tangent_plane, y, plane, {}, residual, None, frozenset())


@eqx.filter_jit
def _step(y: Coordinates, state: Any, plane: tuple[Array, Array, Array]) -> tuple[Coordinates, Any]:
    y, state, _ = _SOLVER.step(_tangent_plane, y, plane, {}, state, frozenset())
    return y, state


def squared_distance(factor: Float[np.ndarray, "n+1 n+1"], side: np.ndarray) -> float:
    """Squared distance to the minimum in standard errors, over the parameters that are not held by a bound.

    ``side`` is -1 or +1 for a parameter at its lower or upper bound; it is held there if χ² falls further outward.
    """
    r, z = factor[:-1, :-1], factor[:-1, -1]
    r = r[:, ~(side * (r.T @ z) < 0)]
    length = np.linalg.norm(r, axis=0)
    left, singular, _ = np.linalg.svd(r / np.where(length > 0, length, 1), full_matrices=False)
    known = singular > 10 * np.finfo(np.float32).eps
    return float(np.sum((left[:, known].T @ z) ** 2))


class _Pass(NamedTuple):
    y: Coordinates
    triangle: np.ndarray
    predicted: np.ndarray
    converged: bool
    message: str


def _minimise(
    y: Coordinates,
    problem: Problem,
    *,
    tolerance: float,
    max_steps: int,
    history: list[Step],
    progress: Progress | None,
) -> _Pass:
    """Levenberg-Marquardt from ``y`` in at most ``max_steps`` steps, which are appended to ``history``."""
    state = _start(y)
    best: _Pass | None = None
    rejections = 0
    stage = history[-1].stage + 1 if history else 1
    degrees_of_freedom = max(_count(problem.batch) - y.size, 1)
    message, converged = OUT_OF_STEPS, False
    try:
        for _ in range(max_steps):
            started = time.perf_counter()
            trial = state.y_eval
            predicted, factor = _evaluate(trial, problem)
            host = np.asarray(factor, dtype=np.float64)
            finite = bool(np.all(np.isfinite(host)))
            if best is None and not finite:
                raise FitError(_not_finite(np.asarray(predicted), problem.batch))
            if not finite:
                # An infinitely bad point, in numbers whose squares do not overflow: the step is rejected and shortened.
                factor = jnp.zeros_like(factor).at[-1, -1].set(1e15)
            change = float(jnp.max(jnp.abs(trial - y)))
            y, state = _step(y, state, (factor[:, -1], factor[:, :-1], trial))
            accepted = finite and bool(jnp.all(y == trial))
            rejections = 0 if accepted else rejections + 1
            if best is None or accepted:
                best = _Pass(y, host, np.asarray(predicted), False, "")
            distance = squared_distance(best.triangle, np.asarray(problem.side(y)))
            chi2 = float(np.sum(host[:, -1] ** 2)) if finite else float("inf")
            history.append(
                Step(
                    step=len(history),
                    stage=stage,
                    chi2=chi2,
                    reduced_chi2=chi2 / degrees_of_freedom,
                    accepted=accepted,
                    change=change,
                    distance=distance,
                    damping=1 / max(float(state.search_state.step_size), 1e-30),
                    seconds=time.perf_counter() - started,
                )
            )
            if progress is not None:
                progress(history[-1])
            if distance < tolerance:
                converged, message = True, f"converged: χ² would fall by {distance:.2g} more"
                break
            if rejections >= REJECTIONS_AT_ROUNDING and distance < ROUNDING_DISTANCE:
                converged, message = True, f"converged to rounding: χ² would fall by {distance:.2g} more"
                break
            if rejections >= REJECTIONS_AT_MOST:
                message = f"stopped: no step improves the fit, though χ² should fall by {distance:.2g} more"
                break
    except KeyboardInterrupt:
        if best is None:
            raise
        message = INTERRUPTED
    assert best is not None
    return best._replace(converged=converged, message=message)


def _count(batch: Batch) -> int:
    """Number of residuals."""
    return int(jnp.sum(batch.used)) * batch.measured.shape[-1]


def _not_finite(predicted: np.ndarray, batch: Batch) -> str:
    bad = ~np.isfinite(predicted) & np.asarray(batch.used)[..., None]
    images = np.flatnonzero(bad.any((1, 2)))
    if images.size:
        return f"the model is not finite at the start values, in {bad.sum()} pixels and channels of image {images[0] + 1}"
    return "the model is finite at the start values, but its derivatives are not"


def _weigh(problem: Problem, expected: Array) -> Problem:
    """``problem`` with the weights of pixels whose expected signal is ``expected``."""
    weight = jnp.where(problem.batch.used[..., None], 1 / problem.batch.sigma(expected), 0)
    return eqx.tree_at(lambda p: p.weight, problem, weight)


def _starting_exposures(predicted: np.ndarray, batch: Batch) -> Float[np.ndarray, " e"]:
    """Logarithms of the factors that bring the median of measured / predicted to one."""
    ratio = np.asarray(batch.measured) / np.where(predicted > 0, predicted, np.inf)
    usable = np.asarray(batch.used)[..., None] & (ratio > 0) & np.isfinite(ratio)
    index = np.broadcast_to(np.asarray(batch.exposure_index)[:, None], ratio.shape)
    chosen = [ratio[usable & (index == number)] for number in range(batch.exposure_count)]
    return np.array([np.log(np.median(values)) if values.size else 0.0 for values in chosen])


def solve(
    observations: Sequence[Observation],
    *,
    init: Atmosphere,
    free: Sequence[str],
    scaled: Sequence[str] = (),
    model: Model,
    progress: Progress | None = None,
    max_steps: int = MAX_STEPS,
    tolerance: float = TOLERANCE,
) -> Solution:
    """Find the atmosphere that explains ``observations``; see :func:`fitting.fit`, which adds the error bars.

    A fit that does not converge returns the best point found, with ``converged`` False and a message. Raises
    :class:`FitError` for a fit that cannot be started.
    """
    if max_steps < 1:
        raise FitError(f"max_steps: got {max_steps}, expected at least 1")
    if not tolerance > 0:
        raise FitError(f"tolerance: got {tolerance}, expected a number > 0")
    started = time.perf_counter()
    parameters = select(init, free, scaled)
    wavelengths = [float(nm) for nm in init.wavelengths]
    batch = stack(observations, wavelengths)
    names, _ = exposures(observations, wavelengths)
    size = parameters.size + batch.exposure_count
    if _count(batch) < size:
        raise FitError(f"{_count(batch)} pixels and channels cannot determine {size} parameters; mask less or free less")
    problem = _weigh(Problem(model, parameters, batch, jnp.zeros_like(batch.measured)), batch.measured)
    y = jnp.concatenate([parameters.start, jnp.zeros(batch.exposure_count, parameters.start.dtype)])
    if names:
        predicted, _ = _evaluate(y, problem)
        y = y.at[parameters.size :].set(_starting_exposures(np.asarray(predicted), batch))
    history: list[Step] = []
    best = _minimise(
        y,
        problem,
        tolerance=max(tolerance, FIRST_PASS_TOLERANCE),
        max_steps=max_steps,
        history=history,
        progress=progress,
    )
    if best.message != INTERRUPTED and len(history) < max_steps:
        best = _minimise(
            best.y,
            _weigh(problem, jnp.asarray(best.predicted)),
            tolerance=tolerance,
            max_steps=max_steps - len(history),
            history=history,
            progress=progress,
        )
    elif best.converged:
        best = best._replace(converged=False, message=OUT_OF_STEPS)
    total = time.perf_counter() - started
    # What a typical step does not explain is compilation and preparation, which happen once.
    steps = min(total, len(history) * float(np.median([step.seconds for step in history])))
    return Solution(
        parameters=parameters,
        batch=batch,
        exposure_names=names,
        y=best.y,
        triangle=best.triangle,
        predicted=best.predicted,
        history=history,
        residual_count=_count(batch),
        converged=best.converged,
        message=best.message,
        timings={"compile_s": total - steps, "solve_s": steps, "total_s": total},
    )
