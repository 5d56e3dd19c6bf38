"""Which numbers of an atmosphere are free, and the coordinates in which they are solved for.

The solver works in coordinates ``y``, and a bijection maps each to a value in its range. One unit of ``y`` is about
one natural step of the value (a factor e, or one typical size), so that the damping of Levenberg-Marquardt, which is
isotropic in ``y``, restrains all parameters alike:

==================================  ====================================================================================
range                               bijection
==================================  ====================================================================================
value > lower                       :class:`Log`
lower < value < upper               :class:`Logit`
value >= 0, and 0 may be the truth  :class:`Linear`, on a half-line or an interval of ``y``
==================================  ====================================================================================

A clear sky has no absorbing aerosol and a dark sea no albedo, so the bounds of these must be reached, not approached:
in a coordinate that only tends to zero, all derivatives tend to zero with it, and a search that strays there cannot
come back. :class:`Linear` coordinates have true limits, at which the solver stops, and from which it returns when χ²
asks.
"""

import difflib
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from diffatmo.atmosphere import FILE_KEYS, SPECTRAL, Atmosphere
from diffatmo.numerics import safe_divide
from diffatmo.phase import PhaseTable
from fitting._errors import FitError

Coordinates = Float[Array, " n"]


class Bijection(eqx.Module):
    """A smooth increasing map from an interval of coordinates onto the range of a value, element by element."""

    @abstractmethod
    def value(self, y: Float[Array, "..."]) -> Float[Array, "..."]:
        """The value at coordinate ``y``."""

    @abstractmethod
    def coordinate(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """The coordinate of ``value``; may be infinite at the end of its range."""

    @property
    @abstractmethod
    def limits(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """The smallest and largest coordinate, where the value is as good as at its bound."""


class Log(Bijection):
    """value = lower + unit exp(y), within a factor e^±REACH of ``unit``."""

    lower: Float[Array, "..."]
    unit: Float[Array, "..."]

    REACH = 7.0

    def value(self, y):
        """See :class:`Bijection`."""
        return self.lower + self.unit * jnp.exp(y)

    def coordinate(self, value):
        """See :class:`Bijection`."""
        return jnp.log((value - self.lower) / self.unit)

    @property
    def limits(self):
        """See :class:`Bijection`."""
        return jnp.full_like(self.unit, -self.REACH), jnp.full_like(self.unit, self.REACH)


class Logit(Bijection):
    """value = lower + (upper - lower) / (1 + exp(-y)), up to e^-REACH of the width from the ends."""

    lower: Float[Array, "..."]
    upper: Float[Array, "..."]

    REACH = 7.0

    def value(self, y):
        """See :class:`Bijection`."""
        return self.lower + (self.upper - self.lower) * jax.nn.sigmoid(y)

    def coordinate(self, value):
        """See :class:`Bijection`."""
        fraction = (value - self.lower) / (self.upper - self.lower)
        return jnp.log(fraction) - jnp.log1p(-fraction)

    @property
    def limits(self):
        """See :class:`Bijection`."""
        return jnp.full_like(self.lower, -self.REACH), jnp.full_like(self.lower, self.REACH)


class Linear(Bijection):
    """value = unit y, from 0 to ``upper`` inclusive."""

    unit: Float[Array, "..."]
    upper: Float[Array, "..."]

    def value(self, y):
        """See :class:`Bijection`."""
        # The product may round to just above the bound.
        return jnp.where(self.unit * y > self.upper, self.upper, self.unit * y)

    def coordinate(self, value):
        """See :class:`Bijection`."""
        return value / self.unit

    @property
    def limits(self):
        """See :class:`Bijection`."""
        return jnp.zeros_like(self.unit), self.upper / self.unit


class Quantity(NamedTuple):
    """What a number of the result is: ``name`` is the field, and its wavelength in nm where it has one."""

    name: str
    field: str
    wavelength: float | None
    unit: str


class Block(eqx.Module):
    """One free field: its bijection and where it starts.

    With ``ratios`` the coordinate is that of a common factor, and the field is the factor times the ratios.
    """

    field: str = eqx.field(static=True)
    bijection: Bijection
    start: Coordinates
    ratios: Float[Array, " w"] | None

    def value(self, y: Coordinates) -> Float[Array, "..."]:
        """The field's value, in its own shape, at this block's coordinates."""
        value = self.bijection.value(y)
        if self.ratios is not None:
            return value * self.ratios
        return value if self.field in SPECTRAL else value[0]

    @property
    def spectral(self) -> bool:
        """Whether each wavelength has its own coordinate."""
        return self.field in SPECTRAL and self.ratios is None


class Parameters(eqx.Module):
    """The free parameters of one atmosphere, everything else being as in ``init``."""

    init: Atmosphere
    blocks: tuple[Block, ...]

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return sum(block.start.size for block in self.blocks)

    @property
    def start(self) -> Coordinates:
        """Coordinates of ``init``."""
        return jnp.concatenate([block.start for block in self.blocks])

    @property
    def _cuts(self) -> Int[np.ndarray, " b"]:
        """Where the coordinates of one block end and those of the next begin."""
        return np.cumsum([block.start.size for block in self.blocks])[:-1]

    def atmosphere(self, y: Coordinates) -> Atmosphere:
        """The atmosphere at coordinates ``y``."""
        values = [block.value(part) for block, part in zip(self.blocks, jnp.split(y, self._cuts), strict=True)]
        return eqx.tree_at(lambda a: [getattr(a, block.field) for block in self.blocks], self.init, values)

    @property
    def limits(self) -> tuple[Coordinates, Coordinates]:
        """The smallest and the largest coordinates."""
        lower, upper = zip(*(block.bijection.limits for block in self.blocks), strict=True)
        return jnp.concatenate(lower), jnp.concatenate(upper)

    def at_bound(self, y: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " q"]:
        """Whether each number of the free fields is at its bound, in the order of :func:`quantities`."""
        result = []
        for block, part in zip(self.blocks, np.split(y, self._cuts), strict=True):
            lower, upper = (np.asarray(limit) for limit in block.bijection.limits)
            outside = (part <= lower) | (part >= upper)
            result.append(np.broadcast_to(outside, jnp.size(getattr(self.init, block.field))))
        return np.concatenate(result)

    def colours(self) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """The colouring of the Jacobian: for each coordinate the tangent it shares, and the one channel it touches.

        Wavelengths do not mix in any model, so channel w of an image depends on number w of a spectral field only: all
        wavelengths of a field share one tangent. A coordinate that touches every channel has channel -1.
        """
        colour, channel = [], []
        for number, block in enumerate(self.blocks):
            colour += [number] * block.start.size
            channel += list(range(block.start.size)) if block.spectral else [-1]
        return np.array(colour), np.array(channel)


def spectral_name(name: str, wavelength: float) -> str:
    """Name of one wavelength's number."""
    return f"{name}_{wavelength:g}"


_Choice: TypeAlias = Callable[[Atmosphere, Array], Bijection]
"""The bijection of a field, from the atmosphere at the start and the field's value in it."""


def _positive(typical: float) -> _Choice:
    """Log around the start value; a field with a zero in it is linear instead, to be able to leave it."""
    linear = _maybe_zero(typical)

    def choose(init: Atmosphere, value: Array) -> Bijection:
        return Log(jnp.zeros_like(value), value) if bool(jnp.all(value > 0)) else linear(init, value)

    return choose


def _maybe_zero(typical: float, upper: float = jnp.inf) -> _Choice:
    """Linear, in units of the largest start value, or of the ``typical`` one if the start is zero."""

    def choose(init: Atmosphere, value: Array) -> Bijection:
        del init
        largest = float(jnp.max(value))
        return Linear(jnp.full_like(value, largest if largest > 0 else typical), jnp.full_like(value, upper))

    return choose


_CHOICES: dict[str, _Choice] = {
    "solar_irradiance": _positive(1.0),
    "bottom_radius": lambda init, value: Logit(jnp.zeros_like(value), init.top_radius[None]),
    "top_radius": lambda init, value: Log(init.bottom_radius[None], init.top_altitude[None]),
    "rayleigh_scattering": _positive(1e-2),
    "rayleigh_scale_height": _positive(8.0),
    "mie_scattering": _positive(4e-3),
    "mie_absorption": _maybe_zero(4e-4),
    "mie_scale_height": _positive(1.2),
    "mie_g": lambda init, value: Logit(-jnp.ones_like(value), jnp.ones_like(value)),
    "ozone_absorption": _maybe_zero(1e-3),
    "ground_albedo": _maybe_zero(0.3, upper=1.0),
    "ozone_center_altitude": _positive(25.0),
    "ozone_half_width": _positive(15.0),
}
"""The fields that can be free. Typical sizes matter only to a field that starts at zero."""

FREE_FIELDS = tuple(_CHOICES)
"""Names of the fields that can be free."""


def _unit(field: str) -> str:
    suffix = FILE_KEYS.get(field, field).removeprefix(field)
    return {"_km": "km", "_per_km": "1/km", "_nm": "nm", "": ""}[suffix]


def quantities(fields: Sequence[str], wavelengths: Sequence[float]) -> list[Quantity]:
    """What each number of ``fields`` is, in order; spectral fields have one number per wavelength."""
    result = []
    for field in fields:
        if field in SPECTRAL or field in DERIVED:
            result += [Quantity(spectral_name(field, nm), field, nm, _unit(field)) for nm in wavelengths]
        else:
            result.append(Quantity(field, field, None, _unit(field)))
    return result


DERIVED: dict[str, tuple[Callable[[Atmosphere], Float[Array, " w"]], tuple[str, ...]]] = {
    "rayleigh_optical_depth": (
        lambda a: a.rayleigh_optical_depth,
        ("rayleigh_scattering", "rayleigh_scale_height"),
    ),
    "mie_optical_depth": (
        lambda a: a.mie_optical_depth,
        ("mie_scattering", "mie_absorption", "mie_scale_height"),
    ),
    "mie_single_scattering_albedo": (
        lambda a: safe_divide(a.mie_scattering, a.mie_extinction),
        ("mie_scattering", "mie_absorption"),
    ),
}
"""Combinations that images determine better than their factors: name -> (function, the fields it depends on)."""


def derived_fields(free: Sequence[str]) -> list[str]:
    """The derived quantities that vary when the fields ``free`` do."""
    return [name for name, (_, ingredients) in DERIVED.items() if set(ingredients) & set(free)]


def numbers(atmosphere: Atmosphere, fields: Sequence[str]) -> Float[Array, " q"]:
    """The numbers of ``fields``, derived ones included, in the order of :func:`quantities`."""
    values = [DERIVED[name][0](atmosphere) if name in DERIVED else getattr(atmosphere, name) for name in fields]
    return jnp.concatenate([jnp.atleast_1d(value) for value in values])


def _unknown(name: Any, allowed: Sequence[str]) -> str:
    close = difflib.get_close_matches(str(name), allowed, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return f"{name!r} cannot be free{hint} (possible: {', '.join(allowed)})"


def select(init: Atmosphere, free: Sequence[str], scaled: Sequence[str] = ()) -> Parameters:
    """Make the fields ``free`` of ``init`` free.

    A spectral field is free at every wavelength, or, if it is in ``scaled`` as well, by one factor that keeps the
    ratios of ``init``. Raises :class:`FitError` for a name that cannot be free.
    """
    if isinstance(free, str) or isinstance(scaled, str):
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
    for name in scaled:
        if name not in free:
            raise FitError(f"scaled: {name!r} is not among the free parameters ({', '.join(free)})")
        if name not in SPECTRAL:
            raise FitError(f"scaled: {name!r} has no wavelengths to scale together")
    return Parameters(init, tuple(_block(init, name, name in scaled) for name in free))


def _block(init: Atmosphere, field: str, scaled: bool) -> Block:
    value = jnp.atleast_1d(getattr(init, field))
    if not scaled:
        bijection = _CHOICES[field](init, value)
        lower, upper = bijection.limits
        return Block(field, bijection, jnp.clip(bijection.coordinate(value), lower, upper), None)
    largest = jnp.max(value)
    if largest == 0:
        raise FitError(f"scaled: {field!r} starts at zero at every wavelength, so no factor can change it")
    one = jnp.ones_like(value, shape=(1,))
    # A little below one, because the product of factor and ratio is rounded.
    upper = (1 - 1e-6) * one / largest if field == "ground_albedo" else jnp.inf * one
    return Block(field, Linear(one, upper), one, value)
