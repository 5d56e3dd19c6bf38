"""Smooth maps between the coordinates of the solver and the values of parameters.

One unit of a coordinate is about one natural step of the value (a factor e, or one typical size), so that the damping of
Levenberg-Marquardt, which is isotropic in the coordinates, restrains all parameters alike:

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

from abc import abstractmethod
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo.numerics import array


def _of_jax(value: Any) -> Array:
    return array(value, value.dtype)


Numbers: TypeAlias = Float[Array, "..."] | Float[np.ndarray, "..."]


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


def _ends(like: Numbers, reach: float) -> tuple[Numbers, Numbers]:
    ends = np.full(like.shape, reach, like.dtype)
    return -ends, ends


class Log(Bijection):
    """value = lower + unit exp(y), within a factor e^±REACH of ``unit``."""

    lower: Numbers = eqx.field(converter=_of_jax)
    unit: Numbers = eqx.field(converter=_of_jax)

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
        return _ends(self.unit, self.REACH)


class Logit(Bijection):
    """value = lower + (upper - lower) / (1 + exp(-y)), up to e^-REACH of the width from the ends."""

    lower: Numbers = eqx.field(converter=_of_jax)
    upper: Numbers = eqx.field(converter=_of_jax)

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
        return _ends(self.lower, self.REACH)


class Linear(Bijection):
    """value = unit y, from 0 to ``upper`` inclusive."""

    unit: Numbers = eqx.field(converter=_of_jax)
    upper: Numbers = eqx.field(converter=_of_jax)

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
