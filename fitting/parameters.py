"""Which numbers of an atmosphere are free, how they hang together, and the coordinates in which they are solved for.

*Columns.* Images determine an optical depth τ = β H far better than its factors (a scale height moves light up and down, an
optical depth makes it), so the coordinate of a coefficient is that of its column: where the scale height is free as well, the
coefficient is divided by how much that has grown. The solver thus works in (τ, H), whose correlation is weak; what is
reported are β, H and τ alike.

*Ties* say how the numbers of a spectral field hang together:

==============  ======================================================================================  =================
tie             meaning                                                                                 coordinates
==============  ======================================================================================  =================
``start``       a common factor times the values of the start                                           1
``grey``        the same at every wavelength                                                            1
``lambda^-4``   Rayleigh scattering ∝ λ⁻⁴                                                               1
``dobson``      the spectrum of ozone's cross section; the factor is its column in Dobson units         1
``angstrom``    of ``mie``: extinction ∝ λ^-α (Ångström 1929), one single scattering albedo             2 or 3
==============  ======================================================================================  =================
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from diffatmo import spectrum
from diffatmo._names import did_you_mean
from diffatmo.atmosphere import SPECTRAL, Atmosphere
from diffatmo.compiling import outermost
from diffatmo.numerics import array
from diffatmo.phase import PhaseTable
from fitting._errors import FitError
from fitting.bijections import Bijection, Linear, Log, Logit
from fitting.quantities import ALWAYS, REFERENCE_NM, derived_fields

Coordinates = Float[Array, " n"]

START, GREY, LAMBDA_4, DOBSON, ANGSTROM = "start", "grey", "lambda^-4", "dobson", "angstrom"
MIE = "mie"
"""The aerosol as a whole, which ``angstrom`` ties."""

TIES: dict[str, tuple[str, ...]] = {
    START: SPECTRAL[1:],
    GREY: SPECTRAL[1:],
    LAMBDA_4: ("rayleigh_scattering",),
    DOBSON: ("ozone_absorption",),
    ANGSTROM: (MIE,),
}
"""Tie -> what it can be said of."""

_COLUMNS = (
    ("rayleigh_scattering", "rayleigh_scale_height"),
    ("mie_scattering", "mie_scale_height"),
    ("mie_absorption", "mie_scale_height"),
    ("ozone_absorption", "ozone_half_width"),
)
"""Coefficients, and the heights that make columns of them."""


class Block(eqx.Module):
    """Coordinates that belong together, and the fields they set."""

    start: eqx.AbstractVar[Coordinates]
    """The coordinates of the atmosphere at the start, or of what is nearest to it."""

    @property
    @abstractmethod
    def fields(self) -> tuple[str, ...]:
        """The fields that the coordinates set."""

    @property
    @abstractmethod
    def spectral(self) -> bool:
        """Whether coordinate w touches wavelength w alone."""

    @property
    @abstractmethod
    def limits(self) -> tuple[Coordinates, Coordinates]:
        """The smallest and the largest coordinates."""

    @abstractmethod
    def values(self, y: Coordinates) -> list[Array]:
        """The value of each field, in its own shape, at these coordinates."""

    @abstractmethod
    def held(self, y: Float[np.ndarray, " n"]) -> list[Bool[np.ndarray, "..."]]:
        """For each field, whether its numbers are at a bound; one entry stands for all."""


class Single(Block):
    """One field, each of its numbers free, or, with a ``shape``, the shape times one free factor."""

    field: str = eqx.field(static=True)
    bijection: Bijection
    start: Coordinates
    shape: Float[Array, " w"] | None

    @property
    def fields(self) -> tuple[str, ...]:
        """See :class:`Block`."""
        return (self.field,)

    @property
    def spectral(self) -> bool:
        """See :class:`Block`."""
        return self.field in SPECTRAL and self.shape is None

    @property
    def limits(self) -> tuple[Coordinates, Coordinates]:
        """See :class:`Block`."""
        return self.bijection.limits

    def values(self, y):
        """See :class:`Block`."""
        value = self.bijection.value(y)
        if self.shape is not None:
            return [value * self.shape]
        return [value if self.field in SPECTRAL else value[0]]

    def held(self, y):
        """See :class:`Block`."""
        lower, upper = (np.asarray(limit) for limit in self.limits)
        return [(y <= lower) | (y >= upper)]


class Aerosol(Block):
    """Extinction (λ / 550 nm)^-α times that at 550 nm, of which a part is absorbed (Ångström 1929).

    Coordinates: the logarithm of the extinction over that of the start, α, and the absorbed part in units of
    :data:`ABSORBED`, if it is free; else that is a spectrum, ``absorbed``.
    """

    extinction: Float[Array, ""]
    absorbed: Float[Array, " w"] | None
    ratio: Float[Array, " w"]
    """Wavelength / 550 nm."""
    start: Coordinates

    ABSORBED = 0.1
    LIMITS = ((-Log.REACH, -4.0, 0.0), (Log.REACH, 6.0, 1 / ABSORBED))

    @classmethod
    def build(cls, init: Atmosphere, absorption: bool) -> "Aerosol":
        """Start from the power law nearest to the aerosol of ``init``; ``absorption`` says whether the last is free."""
        scattered, absorbed, wavelengths = map(np.asarray, (init.mie_scattering, init.mie_absorption, init.wavelengths))
        extinction, ratio = scattered + absorbed, wavelengths / np.asarray(REFERENCE_NM, wavelengths.dtype)
        if not np.all(extinction > 0):
            raise FitError(f"tie: {MIE} = {ANGSTROM!r} needs an aerosol to start from, but the start has none")
        depth, x = np.log(extinction.astype(float)), np.log(ratio.astype(float))
        slope, level = np.polyfit(x, depth, 1) if x.size > 1 else (0.0, depth.mean())
        part = absorbed / extinction
        alpha = float(np.clip(-slope, cls.LIMITS[0][1], cls.LIMITS[1][1]))
        start = [0.0, alpha, *[float(part.mean()) / cls.ABSORBED] * absorption]
        dtype = extinction.dtype
        return cls(
            extinction=array(np.exp(level), dtype),
            absorbed=None if absorption else array(part, dtype),
            ratio=array(ratio, dtype),
            start=array(start, dtype),
        )

    @property
    def fields(self) -> tuple[str, ...]:
        """See :class:`Block`."""
        return "mie_scattering", "mie_absorption"

    @property
    def spectral(self) -> bool:
        """See :class:`Block`."""
        return False

    @property
    def limits(self) -> tuple[Coordinates, Coordinates]:
        """See :class:`Block`."""
        lower, upper = (array(limit[: self.start.size], self.start.dtype) for limit in self.LIMITS)
        return lower, upper

    def values(self, y):
        """See :class:`Block`."""
        extinction = self.extinction * jnp.exp(y[0]) * self.ratio ** -y[1]
        absorbed = jnp.clip(self.ABSORBED * y[2], 0, 1) if self.absorbed is None else self.absorbed
        return [extinction * (1 - absorbed), extinction * absorbed]

    def held(self, y):
        """See :class:`Block`."""
        lower, upper = (np.asarray(limit) for limit in self.limits)
        outside = (y <= lower) | (y >= upper)
        both = np.any(outside[:2], keepdims=True)
        return [both, both | outside[2:].any()]


class Parameters(eqx.Module):
    """The free parameters of one atmosphere, everything else being as in ``init``."""

    init: Atmosphere
    blocks: tuple[Block, ...]
    tied: tuple[str, ...] = eqx.field(static=True, default=())
    """Derived quantities that have a meaning because of a tie."""

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return sum(block.start.size for block in self.blocks)

    @property
    def fields(self) -> list[str]:
        """The free fields, in the order of the blocks."""
        return [field for block in self.blocks for field in block.fields]

    @property
    def derived(self) -> list[str]:
        """The derived quantities that are worth a line in the result."""
        return derived_fields(self.fields, (*ALWAYS, *self.tied))

    @property
    def start(self) -> Coordinates:
        """Coordinates of the start: those of ``init``, or of what is nearest to it under the ties."""
        return jnp.concatenate([block.start for block in self.blocks])

    def _split(self, y: Any) -> list[Any]:
        """The coordinates of each block."""
        ends = np.cumsum([block.start.size for block in self.blocks])
        return [y[end - block.start.size : end] for block, end in zip(self.blocks, ends, strict=True)]

    def atmosphere(self, y: Coordinates) -> Atmosphere:
        """The atmosphere at coordinates ``y``."""
        values: dict[str, Array] = {}
        for block, part in zip(self.blocks, self._split(y), strict=True):
            values |= dict(zip(block.fields, block.values(part), strict=True))
        for coefficient, height in _COLUMNS:
            if coefficient in values and height in values:
                values[coefficient] *= getattr(self.init, height) / values[height]
        return eqx.tree_at(lambda a: [getattr(a, field) for field in values], self.init, list(values.values()))

    @property
    def limits(self) -> tuple[Coordinates, Coordinates]:
        """The smallest and the largest coordinates."""
        lower, upper = zip(*(block.limits for block in self.blocks), strict=True)
        return jnp.concatenate(lower), jnp.concatenate(upper)

    def at_bound(self, y: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " q"]:
        """Whether each number of the free fields is at its bound, in the order of ``quantities(fields, …)``."""
        return np.concatenate(
            [
                np.broadcast_to(held, jnp.size(getattr(self.init, field)))
                for block, part in zip(self.blocks, self._split(y), strict=True)
                for field, held in zip(block.fields, block.held(part), strict=True)
            ]
        )

    def colours(self) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """The colouring of the Jacobian: for each coordinate the tangent it shares, and the one channel it touches.

        Wavelengths do not mix in any model, so channel w of an image depends on number w of a spectral field only: all
        wavelengths of a field share one tangent. A coordinate that touches every channel has channel -1.
        """
        colour: list[int] = []
        channel: list[int] = []
        for block in self.blocks:
            count, following = block.start.size, max(colour, default=-1) + 1
            colour += [following] * count if block.spectral else list(range(following, following + count))
            channel += list(range(count)) if block.spectral else [-1] * count
        return np.array(colour), np.array(channel)


_Choice: TypeAlias = Callable[[Atmosphere, np.ndarray, np.ndarray], Bijection]
"""The bijection of a value: from the atmosphere at the start, the start value, and one over the unit it is given in."""


def _positive(typical: float) -> _Choice:
    """Log around the start value; a field with a zero in it is linear instead, to be able to leave it."""
    linear = _maybe_zero(typical)

    def choose(init: Atmosphere, value: np.ndarray, per_unit: np.ndarray) -> Bijection:
        return Log(np.zeros_like(value), value) if bool(np.all(value > 0)) else linear(init, value, per_unit)

    return choose


def _maybe_zero(typical: float, upper: float = jnp.inf) -> _Choice:
    """Linear, in units of the largest start value, or of the ``typical`` one if the start is zero."""

    def choose(init: Atmosphere, value: np.ndarray, per_unit: np.ndarray) -> Bijection:
        del init
        largest = float(np.max(value))
        unit = np.full_like(value, largest) if largest > 0 else np.full_like(value, typical) / per_unit
        # Where there is a shape, a little below the bound, because its product with the factor is rounded.
        bound = np.full_like(value, upper) / per_unit
        return Linear(unit, np.where(per_unit == 1, bound, (1 - 1e-6) * bound))

    return choose


_CHOICES: dict[str, _Choice] = {
    "solar_irradiance": _positive(1.0),
    "bottom_radius": lambda init, value, _: Logit(np.zeros_like(value), np.asarray(init.top_radius)[None]),
    "top_radius": lambda init, value, _: Log(np.asarray(init.bottom_radius)[None], np.asarray(init.top_altitude)[None]),
    "rayleigh_scattering": _positive(1e-2),
    "rayleigh_scale_height": _positive(8.0),
    "mie_scattering": _positive(4e-3),
    "mie_absorption": _maybe_zero(4e-4),
    "mie_scale_height": _positive(1.2),
    "mie_g": lambda init, value, _: Logit(-np.ones_like(value), np.ones_like(value)),
    "ozone_absorption": _maybe_zero(1e-3),
    "ground_albedo": _maybe_zero(0.3, upper=1.0),
    "ozone_center_altitude": _positive(25.0),
    "ozone_half_width": _positive(15.0),
}
"""The fields that can be free. Typical sizes matter only to a field that starts at zero."""

FREE_FIELDS = tuple(_CHOICES)
"""Names of the fields that can be free."""


def _unknown(name: Any, allowed: Sequence[str]) -> str:
    return f"{name!r} cannot be free{did_you_mean(name, allowed)} (possible: {', '.join(allowed)})"


def select(init: Atmosphere, free: Sequence[str], tie: Mapping[str, str] | None = None) -> Parameters:
    """Make the fields ``free`` of ``init`` free.

    A spectral field is free at every wavelength, unless ``tie`` says how its numbers hang together (see the head of this
    module). Raises :class:`FitError` for a name that cannot be free, or a tie that cannot be.
    """
    if isinstance(free, str):
        raise FitError("free: got one string, expected a list of names")
    for name in free:
        if name not in _CHOICES:
            raise FitError(f"free: {_unknown(name, FREE_FIELDS)}")
    if not free:
        raise FitError(f"free: no parameter given; possible are {', '.join(FREE_FIELDS)}")
    repeated = sorted({name for name in free if list(free).count(name) > 1})
    if repeated:
        raise FitError(f"free: {repeated[0]!r} is given twice")
    if {"bottom_radius", "top_radius"} <= set(free):
        raise FitError("free: bottom_radius and top_radius bound each other; free only one of them")
    if "mie_g" in free and isinstance(init.mie_phase, PhaseTable):
        raise FitError("free: 'mie_g' means nothing to an aerosol with a tabulated phase function")
    if not isinstance(tie, Mapping | None):
        raise FitError(f"tie: got {tie!r}, expected a kind for each name, like {{'mie_scattering': 'grey'}}")
    ties = dict(tie or {})
    _check_ties(ties, free)
    blocks: list[Block] = []
    for name in free:
        if ties.get(MIE) == ANGSTROM and name in ("mie_scattering", "mie_absorption"):
            if name == "mie_scattering":
                blocks.append(Aerosol.build(init, "mie_absorption" in free))
        else:
            blocks.append(_single(init, name, ties.get(name)))
    tied = ["ozone_column"] * (DOBSON in ties.values())
    if ANGSTROM in ties.values():
        at_reference = bool(np.any(np.isclose(np.asarray(init.wavelengths), REFERENCE_NM)))
        tied += [
            "mie_angstrom_exponent",
            "visibility",
            "turbidity",
            *[f"mie_optical_depth_{REFERENCE_NM:g}"] * (not at_reference),
        ]
    return Parameters(init, tuple(blocks), tuple(tied))


def _check_ties(tie: dict[str, str], free: Sequence[str]) -> None:
    """Refuse ties that cannot be."""
    for name, kind in tie.items():
        if kind not in TIES:
            raise FitError(f"tie: {name} = {kind!r} is unknown; ties are {', '.join(TIES)}")
        if name not in TIES[kind]:
            raise FitError(f"tie: {name} cannot be {kind!r}, which is for {', '.join(TIES[kind])}")
        if name != MIE and name not in free:
            raise FitError(f"tie: {name!r} is not among the free parameters ({', '.join(free)})")
    if tie.get(MIE) == ANGSTROM:
        if "mie_scattering" not in free:
            raise FitError(f"tie: {MIE} = {ANGSTROM!r} needs mie_scattering among the free parameters")
        for name in ("mie_scattering", "mie_absorption"):
            if name in tie:
                raise FitError(f"tie: {name} is tied by {MIE} = {ANGSTROM!r} already; leave out the other tie")


def _single(init: Atmosphere, field: str, tie: str | None) -> Single:
    value = np.atleast_1d(np.asarray(getattr(init, field)))
    shape = None
    if tie is not None:
        shape = _shape(init, field, tie)
        value = (np.sum(value) / np.sum(shape))[None]
    per_unit = np.ones(1, value.dtype) if shape is None else np.max(shape)[None]
    bijection = _CHOICES[field](init, value, per_unit)
    start = outermost(_coordinate)(bijection, value)
    return Single(field=field, bijection=bijection, start=start, shape=None if shape is None else jax.device_put(shape))


def _coordinate(bijection: Bijection, value: Array) -> Array:
    return jnp.clip(bijection.coordinate(value), *bijection.limits)


def _shape(init: Atmosphere, field: str, tie: str) -> Float[np.ndarray, " w"]:
    """The spectrum of a tied field, in the unit of its factor."""
    value, wavelengths = np.asarray(getattr(init, field)), np.asarray(init.wavelengths)
    if tie == START:
        if not bool(np.any(value > 0)):
            raise FitError(
                f"tie: {field} = {START!r}: it starts at zero at every wavelength, so no factor can change it"
            )
        return value
    if tie == LAMBDA_4:
        return (wavelengths / REFERENCE_NM) ** -4
    if tie == DOBSON:
        try:
            return np.asarray(
                spectrum.ozone_absorption(init.wavelengths, column_du=1.0, half_width=init.ozone_half_width)
            )
        except ValueError as error:
            raise FitError(f"tie: {field} = {DOBSON!r}: {error}") from error
    return np.ones_like(value)
