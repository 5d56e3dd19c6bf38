"""What would another photograph buy? Error bars before it is taken.

What a photograph can tell of an atmosphere does not depend on how its noise will fall: with J the Jacobian of its whitened
residuals, its Fisher information is JᵀJ, that of independent photographs adds up, and no unbiased estimate has a smaller
covariance than the inverse of the sum (Cramér and Rao). The least squares of :func:`fitting.fit` reach that bound, so it is
the error bar that a fit will report.

*Shots* are photographs that might be taken: the whole sky, ordinary photographs in several directions, the aureole, and the
sun's disc through a filter, each under several suns. They share the atmosphere, so one solution of the sky, with its
derivatives, serves all of them.

*Nuisances*: where an exposure is not known, or any other of :mod:`fitting.nuisances`, the information that is left is what no
choice of it could imitate, and the projection that leaves it is exact. What several images share is eliminated after their
information has been added. Of a shot only the exposure may be unknown.

*Gain* is the ratio of standard errors without and with a shot. A number that the images do not determine has none, so gains
are reckoned as if every coordinate had been known beforehand to within :data:`VAGUE` natural units, a factor of twenty. The
error bars themselves contain no such knowledge.

The bounds know the noise alone. Clouds, flare, and what the model leaves out are not noise: a shot whose promise rests on many
pixels keeps it only as far as the model is right.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffatmo import transmittance
from diffatmo._names import did_you_mean
from diffatmo.atmosphere import Atmosphere
from diffatmo.camera import Camera, Fisheye, Pinhole
from diffatmo.compiling import compile_ahead, outermost
from diffatmo.models import Model, Moments
from diffatmo.numerics import array, safe_log
from fitting._errors import FitError
from fitting.batch import Batch, stack
from fitting.elimination import eliminate, starting, without
from fitting.evaluation import check_finite, evaluated, pose
from fitting.least_squares import known_rows, slopes, triangle
from fitting.linearisation import derivatives, linearise
from fitting.nuisances import gather
from fitting.observation import FIXED, NOISE, PER_CHANNEL, Observation, observe, sigma
from fitting.parameters import Coordinates, Parameters, select
from fitting.priors import Prior, Priors, collect
from fitting.problem import Problem, lit_weights, planet_shell
from fitting.quantities import DERIVED, Quantity, numbers, quantities
from fitting.uncertainty import propagate

VAGUE = 3.0
"""What is known of a coordinate before any image, in natural units; only gains take it in."""

SUNS = tuple(math.radians(zenith) for zenith in (20.0, 40.0, 60.0, 75.0, 85.0, 90.0, 93.0, 95.0))
"""Zenith angles of the sun under which shots are considered, rad."""

LOWEST_DISC = math.radians(85.0)
"""Largest zenith angle of a sun that is photographed itself: below, refraction lengthens its path."""

FRAME = 128
"""Pixels across a simulated frame."""

AVERAGES = 1024
"""Averages of pixels, at most, by which a frame is represented."""

WHOLE_SKY, WHOLE_SKY_BRACKETED, DISC = "whole sky", "whole sky, bracketed", "sun's disc through a filter"


@dataclass(frozen=True)
class Shot:
    """A photograph that might be taken; ``sun_zenith`` in rad, ``exposure`` as in :func:`fitting.observe`."""

    kind: str
    sun_zenith: float
    exposure: str = FIXED

    @property
    def name(self) -> str:
        """What to tell the photographer, but for the exposure."""
        return f"{self.kind}, sun at {math.degrees(self.sun_zenith):g}°"

    @property
    def towards_sun(self) -> Float[np.ndarray, "3"]:
        """Unit vector; the sun is in the north."""
        return np.array([0.0, math.sin(self.sun_zenith), math.cos(self.sun_zenith)])


@dataclass(frozen=True)
class Photo(Shot):
    """A frame of the sky: ``fov`` across it, ``yaw`` from the sun's azimuth, ``pitch`` above the horizon, all rad.

    With a field of view of 180° or more it is an equidistant fisheye's, otherwise an ordinary lens's. ``bracketed``: a shorter
    and a longer exposure add what is too bright and too dark for one.
    """

    fov: float = math.pi
    yaw: float = 0.0
    pitch: float = math.pi / 2
    bracketed: bool = False

    @property
    def view(self) -> tuple[float, ...]:
        """All that the radiance of the pixels depends on."""
        return self.sun_zenith, self.fov, self.yaw, self.pitch

    def camera(self, size: int = FRAME) -> Camera:
        """The camera, with square frames of ``size`` pixels across."""
        fov, yaw, pitch = (array(angle) for angle in (self.fov, self.yaw, self.pitch))
        if self.fov >= math.pi:
            return Fisheye(size, size, fov=fov, yaw=yaw, pitch=pitch)
        return Pinhole(size, size, fov_y=fov, yaw=yaw, pitch=pitch)


@dataclass(frozen=True)
class SunsDisc(Shot):
    """The sun itself through a neutral filter: one number per channel, the direct transmittance times the exposure.

    A filter has a transmittance of its own, so an exposure shared with a group of images is a free one here.
    """


@dataclass(frozen=True)
class Sensor:
    """The camera that takes the shots.

    A frame is worth ``pixels`` pixels of relative noise ``noise``, whatever its field of view. In a single exposure, pixels
    brighter than ``brightest`` times the frame's median are saturated, and read noise takes over below ``darkest`` times the
    median. ``disc_noise`` is the relative error of the sun's disc through a filter.
    """

    noise: float = NOISE
    pixels: float = 4096.0
    brightest: float = 8.0
    darkest: float = 0.1
    disc_noise: float = 0.01

    @classmethod
    def like(cls, observations: Sequence[Observation]) -> "Sensor":
        """That of images: their mean number of pixels, and the noise that tells as much; the default without images."""
        if not observations:
            return cls()
        signals = [np.asarray(o.image / sigma(o, o.image), dtype=np.float64)[o.used] for o in observations]
        noise = 1 / math.sqrt(np.mean([np.mean(signal**2) for signal in signals]))
        return cls(noise=noise, pixels=float(np.mean([o.shown.sum() for o in observations])))


def candidates(suns: Sequence[float] = SUNS, exposures: Sequence[str] = (FIXED,)) -> list[Shot]:
    """The shots to choose from, under ``suns`` (zenith angles, rad), each with every one of ``exposures``."""
    deg = math.radians
    shots: list[Shot] = []
    for zenith in suns:
        shots += [
            Photo(WHOLE_SKY, zenith),
            Photo(WHOLE_SKY_BRACKETED, zenith, bracketed=True),
            Photo("60° toward the sun", zenith, fov=deg(60), pitch=deg(30)),
            Photo("60° across", zenith, fov=deg(60), yaw=deg(90), pitch=deg(30)),
            Photo("60° away from the sun", zenith, fov=deg(60), yaw=deg(180), pitch=deg(30)),
            Photo("60° overhead", zenith, fov=deg(60)),
            Photo("25° of horizon toward the sun", zenith, fov=deg(25), pitch=deg(12.5)),
            Photo("25° of horizon away from the sun", zenith, fov=deg(25), yaw=deg(180), pitch=deg(12.5)),
        ]
        if zenith < math.pi / 2:
            shots.append(Photo("20° around the sun, short exposure", zenith, fov=deg(20), pitch=math.pi / 2 - zenith))
        if zenith <= LOWEST_DISC:
            shots.append(SunsDisc(DISC, zenith))
    return [replace(shot, exposure=exposure) for exposure in exposures for shot in shots]


# Information --------------------------------------------------------------------------------------------------------


class Information(NamedTuple):
    """Fisher information FᵀF of some data, held as the factor F: the product would square its condition number.

    The columns of ``factor`` are the nuisances named, then the coordinates of the atmosphere.
    """

    nuisances: tuple[str, ...]
    factor: Float[np.ndarray, "rows e+n"]


def nothing(size: int) -> Information:
    """The information of no data on ``size`` coordinates."""
    return Information((), np.zeros((0, size)))


def combined(parts: Sequence[Information]) -> Information:
    """The sum of the information of independent data; at least one part."""
    names = tuple(dict.fromkeys(name for part in parts for name in part.nuisances))
    rows = []
    for part in parts:
        own = len(part.nuisances)
        wide = np.zeros((len(part.factor), len(names) + part.factor.shape[1] - own))
        wide[:, [names.index(name) for name in part.nuisances]] = part.factor[:, :own]
        wide[:, len(names) :] = part.factor[:, own:]
        rows.append(wide)
    return Information(names, _compact(np.concatenate(rows)))


def without_nuisances(information: Information) -> Float[np.ndarray, "rows n"]:
    """A factor of the information on the atmosphere alone, whatever the nuisances.

    What their columns span is projected out of the others, which leaves the Schur complement.
    """
    own = len(information.nuisances)
    return _compact(without(information.factor[:, :own], information.factor[:, own:]))


def _compact(factor: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "rows n"]:
    """The same information in no more rows than columns."""
    return np.asarray(np.linalg.qr(factor, mode="r")) if factor.shape[0] > factor.shape[1] else factor


def _information(
    y: Coordinates, columns: Float[np.ndarray, "image w row k"], problem: Problem, names: Sequence[str]
) -> Information:
    """That of images of which these are the columns of the whitened residuals, and of what is known besides."""
    slope = slopes(y, columns, problem).reshape(-1, y.size)
    if problem.known:
        slope = np.concatenate([slope, known_rows(y, problem)[1]])
    factor = triangle(np.zeros(len(slope)), slope)[:-1, :-1]
    return Information(tuple(names), np.roll(factor, len(names), axis=1))


def of_observations(observations: Sequence[Observation], parameters: Parameters, model: Model) -> Information:
    """What images that were taken tell, if ``parameters.init`` is the atmosphere they show."""
    if not observations:
        return nothing(parameters.size)
    wavelengths = [float(nm) for nm in parameters.init.wavelengths]
    batch = stack(observations, wavelengths)
    labels, _ = gather(observations, wavelengths)
    problem = pose(batch, parameters, (), None, model)
    problem = replace(problem, shell=outermost(planet_shell)(model, parameters))
    found = evaluated(problem.start, jnp.zeros(batch.nuisances.linear, problem.start.dtype), problem)
    check_finite(np.asarray(found.bad), [observation.name for observation in observations], "in the atmosphere given")
    linear = array(starting(np.asarray(found.radiance), batch), problem.start.dtype)
    y = eliminate(jnp.concatenate([problem.start, linear]), found, problem)
    problem = replace(problem, weight=outermost(lit_weights)(y, found.radiance, problem))
    found = evaluated(*problem.split(y), problem)
    return _information(y, np.asarray(found.rows, float), problem, [label.name for label in labels])


def of_priors(priors: Sequence[Prior], parameters: Parameters) -> Information:
    """What is known besides any image."""
    known = collect(priors, parameters)
    if known is None:
        return nothing(parameters.size)
    slope = np.asarray(outermost(_prior_slope)(parameters.start, parameters, known), dtype=np.float64)
    return Information((), slope)


def _prior_slope(y: Coordinates, parameters: Parameters, known: Priors) -> Float[Array, "k n"]:
    return jax.jacfwd(lambda y: known.residuals(parameters.atmosphere(y)))(y)


def of_shots(
    shots: Sequence[Shot], parameters: Parameters, model: Model, *, sensor: Sensor, altitude: float
) -> list[Information]:
    """What each shot, taken from ``altitude`` km, would tell if ``parameters.init`` is the atmosphere it will show.

    Raises :class:`FitError` for a photo with no pixel of the sky in its frame.
    """
    frames = {
        photo.view: _frame(photo, parameters.init, sensor, altitude) for photo in shots if isinstance(photo, Photo)
    }
    rows = {view: number for number, view in enumerate(frames)}
    wavelengths = [float(nm) for nm in parameters.init.wavelengths]
    if frames:
        images = [replace(frame, name=f"{frame.name} {number}") for number, frame in enumerate(frames.values())]
        problem = pose(stack(images, wavelengths), parameters, (), None, model)
        # Each photo will have weights of its own.
        problem = replace(problem, shell=outermost(planet_shell)(model, parameters), fields=None)
        found = jax.tree.map(np.asarray, outermost(derivatives)(problem.start, problem))
        lost = [~np.isfinite(values).reshape(*values.shape[:2], -1).all(axis=-1) for values in found]
        used = np.asarray(problem.batch.used)
        bad = np.stack([np.sum(used & values, axis=1) for values in lost], axis=-1)
        check_finite(bad, [frame.name for frame in frames.values()], "in the atmosphere given")
    result = []
    for shot in shots:
        if isinstance(shot, Photo):
            row = slice(rows[shot.view], rows[shot.view] + 1)
            own = jax.tree.map(lambda x, row=row: x[row], problem.batch)
            labels, nuisances = gather(
                [replace(frames[shot.view], name=shot.name, exposure=shot.exposure)], wavelengths
            )
            own = replace(own, nuisances=nuisances)
            radiance = found.radiance[row].astype(np.float64)
            known = [found.tangents[row], radiance[..., None], *[np.ones_like(radiance)[..., None]] * 2]
            columns = np.concatenate(known, axis=-1) * _weight(shot, radiance, own, sensor)[..., None]
            y = jnp.concatenate([problem.start, jnp.zeros(nuisances.linear, problem.start.dtype)])
            alone = replace(problem, batch=own)
            part = _information(y, np.swapaxes(columns, 1, 2), alone, [label.name for label in labels])
        else:
            part = _disc_information(shot, parameters, sensor, altitude)
        result.append(part)
    return result


def _frame(photo: Photo, atmosphere: Atmosphere, sensor: Sensor, altitude: float) -> Observation:
    """The pixels of a photo, of which the content is not known yet."""
    camera = photo.camera()
    pixels = np.ones((FRAME, FRAME, atmosphere.wavelengths.size), dtype=np.float32)
    return observe(
        pixels,
        camera=camera,
        altitude=altitude,
        sun=photo.towards_sun,
        noise=sensor.noise * math.sqrt(np.asarray(camera.valid()).sum() / sensor.pixels),
        max_pixels=AVERAGES,
        name=photo.name,
    )


def _weight(
    photo: Photo, light: Float[np.ndarray, "image pixel w"], batch: Batch, sensor: Sensor
) -> Float[np.ndarray, "image pixel w"]:
    """1/sigma of the pixels of one photo; 0 of those saturated, dark, or not in the sky."""
    used = np.asarray(batch.used) & (light > 0).all(axis=-1)
    if not used.any():
        return np.zeros_like(light)
    median, dark = np.median(light[used]), 0.0
    if not photo.bracketed:
        used &= (light <= sensor.brightest * median).all(axis=-1)
        dark = sensor.darkest * median
    deviation = np.asarray(batch.noise) * np.hypot(light, dark)
    return np.where(used[..., None], 1 / np.where(deviation > 0, deviation, np.inf), 0)


def _log_direct(y: Coordinates, parameters: Parameters, altitude: Array, mu_s: Array) -> Float[Array, " w"]:
    """Logarithm of the direct light of the sun."""
    atmosphere = parameters.atmosphere(y)
    columns, _ = transmittance.to_top(atmosphere, altitude, mu_s)
    return safe_log(atmosphere.solar_irradiance) - transmittance.optical_depth(atmosphere, columns)


def _direct_slope(y: Coordinates, parameters: Parameters, altitude: Array, mu_s: Array) -> Float[Array, "w n"]:
    return jax.jacfwd(_log_direct)(y, parameters, altitude, mu_s)


def _disc_information(shot: Shot, parameters: Parameters, sensor: Sensor, altitude: float) -> Information:
    start = parameters.start
    place = [array(value, start.dtype) for value in (altitude, math.cos(shot.sun_zenith))]
    slope = np.asarray(outermost(_direct_slope)(start, parameters, *place), dtype=np.float64)
    if not np.isfinite(slope).all():
        raise FitError(f"{shot.name}: the derivatives of the direct light are not finite")
    channels = len(slope)
    free = np.eye(channels) if shot.exposure.endswith(PER_CHANNEL) else np.ones((channels, 1))
    free = free[:, :0] if shot.exposure == FIXED else free
    weight = np.where(np.asarray(parameters.init.solar_irradiance) > 0, 1 / sensor.disc_noise, 0)[:, None]
    names = tuple(f"exposure_{shot.name}_{number}" for number in range(free.shape[1]))
    return Information(names, np.concatenate([free, slope], axis=1) * weight)


# The plan -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Prospect:
    """What one more shot would do: the gain of each parameter cared for, their geometric mean, and the error bars then.

    ``standard_errors`` are those of the quantities of the :class:`Plan`, None where the images would not determine one.
    """

    shot: Shot
    gain: float
    gains: Mapping[str, float]
    standard_errors: list[float | None]


@dataclass(frozen=True)
class Plan:
    """Shots in the order of what they buy, and a sequence each of which buys most after the ones before.

    ``standard_errors`` are those of the images that there are.
    """

    atmosphere: Atmosphere
    sensor: Sensor
    aims: tuple[str, ...]
    quantities: list[Quantity]
    values: Float[np.ndarray, " q"]
    standard_errors: list[float | None]
    ranking: list[Prospect]
    sequence: list[Prospect]


class Question(NamedTuple):
    """What is asked of the information: numbers, their gradient, and which of them belong to each aim."""

    gradient: Float[np.ndarray, "q n"]
    members: dict[str, Bool[np.ndarray, " q"]]

    def errors(self, information: Information) -> list[float | None]:
        """Standard errors of the numbers; None where they are not determined.

        The nuisances stay coordinates: projected out, they would leave rounding where they imitate a parameter.
        """
        factor = information.factor
        rows, columns = factor.shape
        square = np.concatenate([factor, np.zeros((max(columns - rows, 0), columns))])
        gradient = np.concatenate([np.zeros((len(self.gradient), len(information.nuisances))), self.gradient], axis=1)
        covariance, determined = propagate(square, gradient)
        return [math.sqrt(v) if ok else None for v, ok in zip(np.diag(covariance), determined, strict=True)]

    def vague_errors(self, information: Information) -> Float[np.ndarray, " q"]:
        """Standard errors if every coordinate is known to within :data:`VAGUE` besides."""
        factor = without_nuisances(information)
        square = _compact(np.concatenate([factor, np.eye(factor.shape[1]) / VAGUE]))
        return np.linalg.norm(np.linalg.solve(square.T, self.gradient.T), axis=0)

    def gains(self, before: Float[np.ndarray, " q"], after: Float[np.ndarray, " q"]) -> dict[str, float]:
        """For each aim the geometric mean of the ratios of its numbers' errors; what cannot vary stays as it is."""
        varies = (before > 0) & (after > 0)
        ratio = np.log(np.where(varies, before, 1) / np.where(varies, after, 1))
        return {name: math.exp(np.mean(ratio[chosen])) for name, chosen in self.members.items()}


def relative(
    named: Sequence[Quantity], values: Float[np.ndarray, " q"], errors: Sequence[float | None], name: str
) -> float | None:
    """Root mean square of the relative errors of the numbers called ``name``; None if one is not determined, or zero."""
    chosen = [
        error / abs(value) if error is not None and value else None
        for quantity, value, error in zip(named, values, errors, strict=True)
        if name in (quantity.name, quantity.field)
    ]
    known = [error for error in chosen if error is not None]
    return math.sqrt(sum(x * x for x in known) / len(known)) if known and len(known) == len(chosen) else None


def _numbers(y: Coordinates, parameters: Parameters, fields: tuple[str, ...]) -> tuple[Array, Array]:
    values = numbers(parameters.atmosphere(y), fields)
    return values, values


def _gradient(y: Coordinates, parameters: Parameters, fields: tuple[str, ...]) -> Any:
    return jax.jacfwd(_numbers, has_aux=True)(y, parameters, fields)


def _fields(parameters: Parameters, aims: Sequence[str], wavelengths: Sequence[float]) -> list[str]:
    """The fields that are looked at: free ones, what follows from them, and what else the user cares for."""
    fields = [*parameters.fields, *parameters.derived]
    known = {name for quantity in quantities(fields, wavelengths) for name in (quantity.name, quantity.field)}
    varying = [name for name in aims if name in DERIVED and set(DERIVED[name].ingredients) & set(parameters.fields)]
    return fields + [name for name in varying if name not in known]


def rank(
    shots: Sequence[Shot], parts: Sequence[Information], before: Information, question: Question
) -> list[Prospect]:
    """What each of ``shots`` would add to ``before``, the largest gain first."""
    without = question.vague_errors(before)
    result = []
    for shot, part in zip(shots, parts, strict=True):
        both = combined([before, part])
        gains = question.gains(without, question.vague_errors(both))
        mean = math.exp(sum(math.log(gain) for gain in gains.values()) / len(gains))
        result.append(Prospect(shot, mean, gains, question.errors(both)))
    return sorted(result, key=lambda prospect: -prospect.gain)


def ask(parameters: Parameters, aims: Sequence[str]) -> tuple[Question, list[Quantity], Float[np.ndarray, " q"]]:
    """The question behind ``aims`` (names of fields or single numbers), the numbers it is about, and their values.

    Raises :class:`FitError` for a name that is neither free nor follows from what is.
    """
    wavelengths = [float(nm) for nm in parameters.init.wavelengths]
    fields = _fields(parameters, aims, wavelengths)
    named = quantities(fields, wavelengths)
    members = {}
    for name in aims:
        members[name] = np.array([name in (quantity.name, quantity.field) for quantity in named])
        if not members[name].any():
            hint = did_you_mean(name, [*fields, *(quantity.name for quantity in named)])
            raise FitError(f"for: {name!r} is not free and does not follow from what is{hint} ({', '.join(fields)})")
    gradient, values = outermost(_gradient)(parameters.start, parameters, tuple(fields))
    return Question(np.asarray(gradient, float), members), named, np.asarray(values, float)


def plan(
    observations: Sequence[Observation],
    *,
    atmosphere: Atmosphere,
    free: Sequence[str],
    tie: Mapping[str, str] | None = None,
    priors: Sequence[Prior] = (),
    aims: Sequence[str] | None = None,
    shots: Sequence[Shot] | None = None,
    ranked_only: Sequence[Shot] = (),
    count: int = 3,
    sensor: Sensor | None = None,
    altitude: float | None = None,
    model: Model | None = None,
) -> Plan:
    """Rank what might be photographed next.

    Args:
        observations: The images there are, from :func:`fitting.observe`; may be none.
        atmosphere: The best that is known, about which everything is taken to be linear.
        free: Parameters, ``tie`` their ties, and ``priors`` what is known of them, as in :func:`fitting.fit`.
        aims: Names of the fields, derived ones, or single numbers that matter; by default all that are free. Each counts
            once, however many wavelengths it has.
        shots: To choose from; by default :func:`candidates`.
        ranked_only: Shots to rank besides, of which none is put into the sequence: what if the exposure were known?
        count: Of the shots in the sequence; each is taken at most once, as a repetition averages noise alone.
        sensor: By default like that of the images.
        altitude: Of the shots, km; by default that of the first image, or 0.1.
        model: :class:`~diffatmo.models.moments.Moments` by default.

    Raises:
        FitError: A name that is not a parameter, images that do not go together, a shot that shows no sky.
    """
    parameters = select(atmosphere, free, tie)
    chosen = list(candidates() if shots is None else shots)
    wanted = tuple(dict.fromkeys(parameters.fields if aims is None else aims))
    if not wanted:
        raise FitError("for: no parameter given")
    if count < 0:
        raise FitError(f"shots: got {count}, expected a number of at least 0")
    question, named, values = ask(parameters, wanted)
    own_sensor = Sensor.like(observations) if sensor is None else sensor
    level = altitude if altitude is not None else observations[0].altitude if observations else 0.1
    sky = Moments() if model is None else model
    # The program for the images is compiled while that for the shots is.
    ahead = None
    if observations:
        batch = stack(observations, [float(nm) for nm in atmosphere.wavelengths])
        taken = pose(batch, parameters, (), None, sky)
        ahead = compile_ahead(linearise, taken.start, jnp.zeros(batch.nuisances.linear, taken.start.dtype), taken)
    offered = [*chosen, *ranked_only]
    parts = of_shots(offered, parameters, sky, sensor=own_sensor, altitude=level)
    if ahead is not None:
        ahead.join()
    before = combined([of_priors(priors, parameters), of_observations(observations, parameters, sky)])
    sequence: list[Prospect] = []
    known, left = before, list(zip(chosen, parts[: len(chosen)], strict=True))
    while left and len(sequence) < count:
        best = rank([shot for shot, _ in left], [part for _, part in left], known, question)[0]
        sequence.append(best)
        known = combined([known, next(part for shot, part in left if shot is best.shot)])
        left = [(shot, part) for shot, part in left if shot.name != best.shot.name]
    return Plan(
        atmosphere=atmosphere,
        sensor=own_sensor,
        aims=wanted,
        quantities=named,
        values=values,
        standard_errors=question.errors(before),
        ranking=rank(offered, parts, before, question),
        sequence=sequence,
    )
