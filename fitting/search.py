"""The search: Levenberg-Marquardt on a problem whose evaluations cost seconds.

Each step costs one evaluation of the model with its derivatives over all pixels, compiled once; it comes back as rows
(:mod:`fitting.linearisation`), which are reduced to the triangular factor of [J r], in which optimistix then takes its step.
As the loop over steps runs in Python, progress can be shown, the time of a step is known, and an interrupt ends the fit at
its best point.

*Convergence* is judged in units of the parameters' own uncertainty, as in MINUIT: the squared distance to the
optimum, (Jᵀr)ᵀ (JᵀJ)⁻¹ Jᵀr, says by how much χ² would still fall if the residuals were linear. At a distance of 0.1
every parameter is within a tenth of its standard error of the optimum. Directions that the data leave open to more than
a natural unit of the coordinates, and parameters held by their bounds, do not count.

*Linear nuisances*, exposures and pedestals, are at their optimum wherever χ² is evaluated, and the search is in the other
coordinates alone (:mod:`fitting.elimination`). The weights of a robust loss are those of the residuals at the nuisances that
the last step foresees; where the optimum turns out to be elsewhere, the pixels are gone through again.
"""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from diffatmo.compiling import outermost
from diffatmo.numerics import array
from fitting.batch import Batch
from fitting.elimination import RANK_TOLERANCE, eliminate, profile
from fitting.least_squares import Factor, reduce
from fitting.linearisation import Linearisation
from fitting.parameters import Coordinates
from fitting.problem import Linear, Problem, limits_of

ROUNDING_DISTANCE = 0.3
"""Distance below which rejected steps mean that rounding hides the last of the way."""

REJECTIONS_AT_ROUNDING = 3

REJECTIONS_AT_MOST = 11
"""Each makes the damping four times as large; after as many no step is left in float32."""

LONGEST_STEP = 3.0
"""In natural units: what the derivatives say of a parameter e³ times as large is not worth an evaluation."""

LARGEST_MISFIT = 100.0
"""Reduced χ² up to which residuals are taken for noise that may hide an optimum; beyond it the model is wrong somewhere."""

ASTRAY = 2.0
"""Reduced χ² beyond which the search from the given start is not trusted to have found the best minimum."""

FIRST_PASS_TOLERANCE = 1.0
"""The first pass only has to find the sigma of the second: one standard error from its optimum is near enough."""

AGAIN, AGAIN_AT_MOST = 0.1, 4
"""Fall of a robust χ² with the linear nuisances, in its unit, for which the pixels are gone through again; how often."""

INTERRUPTED = "interrupted by the user"
OUT_OF_STEPS = "stopped: not converged in the steps allowed"
# The test for convergence is made here, so optimistix's own is set out of reach. Its trust region trusts a step only if
# 99 % of the predicted fall of χ² came true, and then takes hundreds of steps along the curved valleys that images with
# few determined combinations have; with 75 % it takes tens.
_SOLVER: optx.LevenbergMarquardt = eqx.tree_at(
    lambda solver: solver.search,
    optx.LevenbergMarquardt(rtol=1e-30, atol=1e-30),
    optx.ClassicalTrustRegion(high_cutoff=0.75, high_constant=3.5),
)


class Step(NamedTuple):
    """One evaluation of the fit.

    ``chi2`` is that of the point tried (infinite where the model was), ``accepted`` whether it became the current one;
    ``change`` is the largest change of a coordinate that led to it (about the relative change of a parameter),
    ``distance`` that from the current point to the optimum, in standard errors, ``damping`` the λ of
    the next step, and ``stage`` counts the searches of the fit, of which ``aim`` says in words what is new in them: χ² is not
    the same from one to another.
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
    aim: str = ""


Progress = Callable[[Step], Any]


def _tangent_plane(y: Coordinates, plane: tuple[Array, Array, Array]) -> tuple[Array, None]:
    residual, jacobian, origin = plane
    # A sum, not a matrix product, which accelerators may run in reduced precision.
    return residual + jnp.sum(jacobian * (y - origin), axis=-1), None


def _start(y: Coordinates) -> Any:
    n = y.size
    plane = (jnp.zeros(n + 1, y.dtype), jnp.zeros((n + 1, n), y.dtype), y)
    residual = jax.ShapeDtypeStruct((n + 1,), y.dtype)
    return _SOLVER.init(_tangent_plane, y, plane, {}, residual, None, frozenset())


def _step(y: Coordinates, state: Any, plane: tuple[Array, Array, Array]) -> tuple[Coordinates, Any]:
    y, state, _ = _SOLVER.step(_tangent_plane, y, plane, {}, state, frozenset())
    return y, state


def distance(factor: Float[np.ndarray, "n+1 n+1"], misfit: float = 1.0) -> float:
    """Distance to the optimum, in standard errors, in the directions that the data determine.

    Its square is the amount by which χ² / ``misfit`` would still fall if the residuals were linear; the variance of the
    noise is taken to be ``misfit`` times the stated one. A direction with the standard error s, in natural units of the
    coordinates, counts by 1 / (1 + s²); there a misfit counts up to :data:`LARGEST_MISFIT`.
    """
    left, singular, _ = np.linalg.svd(factor[:, :-1] / math.sqrt(min(misfit, LARGEST_MISFIT)), full_matrices=False)
    along = left.T @ factor[:, -1] / math.sqrt(misfit)
    return math.sqrt(np.sum(along**2 * singular**2 / (1 + singular**2)))


def _hold(
    factor: Float[np.ndarray, "n+1 n+1"], y: np.ndarray, limits: tuple[np.ndarray, np.ndarray]
) -> Float[np.ndarray, "n+1 n+1"]:
    """``factor`` without the derivatives for coordinates that χ² pushes against their limits: no step moves them."""
    gradient = factor[:, :-1].T @ factor[:, -1]
    held = ((y <= limits[0]) & (gradient > 0)) | ((y >= limits[1]) & (gradient < 0))
    return np.where(np.append(held, False), 0, factor)


def _shorten(y: Coordinates, trial: Coordinates, limits: tuple[np.ndarray, np.ndarray]) -> Coordinates:
    """``trial``, pulled towards ``y`` until no coordinate changes by more than is sensible, and inside the limits."""
    largest = jnp.max(jnp.abs(trial - y))
    return jnp.clip(y + (trial - y) * jnp.minimum(1, LONGEST_STEP / jnp.where(largest > 0, largest, 1)), *limits)


class Point(NamedTuple):
    """A point of the search, and why the search ended if it ended there."""

    y: Coordinates
    linearisation: Linearisation
    triangle: Factor
    chi2: float
    distance: float
    ahead: Coordinates
    """Where the search would have gone on."""
    converged: bool = False
    message: str = OUT_OF_STEPS

    @property
    def onward(self) -> Coordinates:
        """Where the search of a slightly different problem begins."""
        return self.ahead if self.converged else self.y


Evaluate = Callable[[Coordinates, Linear, Problem], Linearisation]
"""The linearisation at ``x``, with the residuals of these linear nuisances."""

Keep = Callable[[Coordinates, float], None]
"""What is done with the best point, and the size of the step from there, after every step."""


def minimise(
    y: Coordinates,
    problem: Problem,
    *,
    evaluate: Evaluate,
    tolerance: float,
    max_steps: int,
    history: list[Step],
    progress: Progress | None,
    keep: Keep,
    start: Linearisation | None = None,
    step_size: float | None = None,
    patience: int | None = None,
    fallback: Point | None = None,
    aim: str = "",
) -> Point:
    """Levenberg-Marquardt from ``y`` until ``history`` holds ``max_steps``; ``start`` is the linearisation there, if known.

    ``step_size`` is that of the first step. After ``patience`` steps a search that has still gone astray ends. Interrupted
    before its first point is known, it ends at ``fallback``, if there is one. ``aim`` is for the history.
    """
    begun = len(history)
    x, linear = problem.split(y)
    state = outermost(_start)(x)
    limits = jax.tree.map(np.asarray, outermost(limits_of)(problem))
    freedom = max(count(problem.batch) - y.size, 1)
    stage = history[-1].stage + 1 if history else 1
    best: Point | None = None
    misfit, scale, rejections = 1.0, 1.0, 0
    trial = outermost(_shorten)(x, state.y_eval, limits)
    try:
        while best is None or len(history) < max_steps:
            started = time.perf_counter()
            found = start if best is None and start is not None else evaluate(trial, linear, problem)
            whole, found, factor = _settled(trial, found, problem, evaluate)
            finite = bool(np.all(np.isfinite(factor)))
            if finite:
                chi2, held = (
                    float(np.sum(factor[:, -1] ** 2)),
                    _hold(profile(factor, linear.size), np.asarray(trial), limits),
                )
            else:
                # An infinitely bad point, in numbers whose squares do not overflow: the step is rejected and shortened.
                chi2, held = math.inf, np.diag([0.0] * x.size + [1e15])
            size = state.search_state.step_size
            if best is None:
                size = size if step_size is None else jnp.full_like(size, step_size)
                misfit = scale = max(1.0, chi2 / freedom)
            elif chi2 < best.chi2:
                # The damping follows the misfit: with λ = 1 a step is restrained to about a natural unit in directions
                # that the data, given residuals of the present size, determine no better than that.
                previous, misfit = misfit, max(1.0, chi2 / freedom)
                size = size * (previous / misfit)
            state = eqx.tree_at(lambda s: (s.y_eval, s.search_state.step_size), state, (trial, size))
            change = float(np.max(np.abs(np.asarray(trial) - np.asarray(x))))
            plane = held / math.sqrt(scale)
            residual, slope = (array(part, x.dtype) for part in (plane[:, -1], plane[:, :-1]))
            x, state = outermost(_step)(x, state, (residual, slope, trial))
            accepted = best is None or (finite and np.array_equal(x, trial))
            if best is None or accepted:
                best = Point(whole, found, factor, chi2, distance(held, misfit), whole)
            trial = outermost(_shorten)(x, state.y_eval, limits)
            linear = _foreseen(best, trial)
            best = best._replace(ahead=jnp.concatenate([trial, linear]))
            rejections = 0 if accepted else rejections + 1
            history.append(
                Step(
                    step=len(history),
                    stage=stage,
                    chi2=chi2,
                    reduced_chi2=chi2 / freedom,
                    accepted=accepted,
                    change=change,
                    distance=best.distance,
                    damping=scale / max(float(state.search_state.step_size), 1e-30),
                    seconds=time.perf_counter() - started,
                    aim=aim,
                )
            )
            keep(best.y, float(state.search_state.step_size))
            if progress is not None:
                progress(history[-1])
            if np.array_equal(trial, x):
                rejections = REJECTIONS_AT_MOST
            end = _end(best.distance, rejections, tolerance)
            if end is not None:
                return best._replace(converged=end[0], message=end[1])
            if patience is not None and len(history) - begun >= patience and best.chi2 > ASTRAY * freedom:
                break
    except KeyboardInterrupt:
        best = best or fallback
        if best is None:
            raise
        return best._replace(converged=False, message=INTERRUPTED)
    return best


TELLING = 0.7
"""Factor by which a distance shrinks in a step, above which nothing follows for the next ones: those far away are short."""


def steps_left(history: list[Step], tolerance: float) -> int | None:
    """How many more steps a fit will take, if its distances go on to shrink as they did last; None while none can tell."""
    stage = history[-1].stage
    accepted = [step.distance for step in history if step.stage == stage and step.accepted]
    aim = tolerance if stage > 1 else max(tolerance, FIRST_PASS_TOLERANCE)
    # Each further pass begins near its optimum; the last is that of a finer model.
    more = 2 * max(3 - stage, 0)
    if accepted and accepted[-1] <= aim:
        return more
    if len(accepted) < 3 or not 0 < accepted[-1] < accepted[-3]:
        return None
    rate = math.sqrt(accepted[-1] / accepted[-3])
    if rate > TELLING:
        return None
    return math.ceil(math.log(aim / accepted[-1]) / math.log(rate)) + more


def _settled(
    x: Coordinates, found: Linearisation, problem: Problem, evaluate: Evaluate
) -> tuple[Coordinates, Linearisation, Factor]:
    """``y`` with the linear nuisances at their optimum for ``x``, the linearisation and the factor there."""
    for again in range(AGAIN_AT_MOST + 1):
        y = eliminate(jnp.concatenate([x, found.linear]), found, problem)
        factor = reduce(y, found, problem)
        if problem.loss is None or not found.linear.size or again == AGAIN_AT_MOST:
            break
        before = reduce(jnp.concatenate([x, found.linear]), found, problem)
        fall = np.sum(before[:, -1] ** 2) - np.sum(factor[:, -1] ** 2)
        if not fall > AGAIN * float(problem.loss.scale) ** 2:
            break
        found = evaluate(x, problem.split(y)[1], problem)
    return y, found, factor


def _foreseen(best: Point, trial: Coordinates) -> Linear:
    """The linear nuisances that the linear model at ``best`` expects for ``trial``."""
    x, linear = best.y[: trial.size], best.y[trial.size :]
    slope, of_linear = best.triangle[:, : trial.size], best.triangle[:, trial.size : -1]
    if not (linear.size and np.all(np.isfinite(best.triangle))):
        return linear
    length = np.linalg.norm(of_linear, axis=0)
    unit = np.where(length > 0, length, 1)
    step = np.asarray(trial, dtype=np.float64) - np.asarray(x, dtype=np.float64)
    left = best.triangle[:, -1] + slope @ step
    change = np.linalg.lstsq(of_linear / unit, -left, rcond=RANK_TOLERANCE)[0] / unit
    return linear + array(change, linear.dtype)


def count(batch: Batch) -> int:
    """Number of residuals."""
    return int(np.sum(np.asarray(batch.used))) * batch.measured.shape[-1]


def _end(away: float, rejections: int, tolerance: float) -> tuple[bool, str] | None:
    """Whether the search has converged and how it ended; None while it has to go on."""
    if away < tolerance:
        return True, f"converged: {away:.2g} standard errors from the optimum"
    if rejections >= REJECTIONS_AT_ROUNDING and away < ROUNDING_DISTANCE:
        return True, f"converged as far as rounding allows: {away:.2g} standard errors from the optimum"
    if rejections >= REJECTIONS_AT_MOST:
        return False, f"stopped: no step improves the fit, {away:.2g} standard errors from where the optimum should be"
    return None
