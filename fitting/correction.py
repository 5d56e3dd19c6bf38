"""What a finer model says over what the fitted one says, and how that changes with what is fitted.

The ratio of the two is known at one place. Along the few directions in which the images leave most room, it is known a step of
one standard error away as well, and taken to be exponential in between:

    ratio(x) = ratio(x₀) exp(Σₖ slopeₖ zₖ),    z = P (x - x₀),

where zₖ are standard errors along direction k, and no other direction changes z. So the derivatives of the light are those of
the finer model where it matters: along a valley, as that of the two scale heights in one picture of a hazy sky, what a
coordinate does is all but undone by others, and of so small a rest the coarser model may have half or double, and with it its
error bars.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo.numerics import array

DIRECTIONS = 3
"""Along which the ratio may change: as many as there are places for, since other shapes would be compiled anew."""

Ratio = Float[Array, "image pixel w"]


class Correction(eqx.Module):
    """The ratio at ``at``, and the derivatives of its logarithm along each direction, in which ``along`` counts the steps."""

    ratio: Ratio
    at: Float[Array, " x"]
    slope: Float[Array, "image pixel w k"]
    along: Float[Array, "k x"]
    """P. All zero for a direction that is not there."""

    @classmethod
    def constant(cls, ratio: Ratio, at: Float[Array, " x"]) -> "Correction":
        """The same ratio everywhere."""
        none = array(np.zeros((*ratio.shape, DIRECTIONS), ratio.dtype), ratio.dtype)
        return cls(ratio, at, none, array(np.zeros((DIRECTIONS, at.size)), at.dtype))

    def steps(self, x: Float[Array, " x"]) -> Float[Array, " k"]:
        """How far ``x`` is along each direction."""
        return jnp.sum(self.along * (x - self.at), axis=-1)


def apply(
    light: Float[Array, "pixel w"],
    tangents: Float[Array, "pixel w t"],
    ratio: Float[Array, "pixel w"],
    slope: Float[Array, "pixel w k"],
    steps: Float[Array, " k"],
) -> tuple[Float[Array, "pixel w"], Float[Array, "pixel w t+k"], Float[Array, "pixel w"]]:
    """The finer model's light from the coarser one's, its derivatives along the tangents and, by the change of the ratio alone,
    along the directions, and the ratio."""
    ratio = ratio * jnp.exp(jnp.sum(slope * steps, axis=-1))
    light = light * ratio
    return light, jnp.concatenate([tangents * ratio[..., None], light[..., None] * slope], axis=-1), ratio
