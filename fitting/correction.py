"""What a finer model says over what the fitted one says, and how that changes with what is fitted.

The ratio of the two is known at one place. Elsewhere it is taken to be exponential in the coordinates along which it changes:

    ratio(x) = ratio(x₀) exp(Σₖ slopeₖ (xₖ - x₀ₖ)),

so that the derivatives of the light are the finer model's along those. They matter along a valley, as that of the two scale
heights in one picture of a hazy sky: what a coordinate does there is all but undone by others, and of so small a rest the
coarser model may have half or double, and with it its error bars.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

SLOPES = 3
"""Tangents along which the ratio may change: as many as there are places for, since other shapes would be compiled anew."""

Ratio = Float[Array, "image pixel w"]
Tangents = Float[Array, "pixel w colour"]


class Correction(eqx.Module):
    """The ratio at ``at``, and the derivatives of its logarithm along the tangents numbered ``colour``; -1 is none."""

    ratio: Ratio
    at: Float[Array, " n"]
    slope: Float[Array, "image pixel w s"]
    colour: Int[Array, " s"]

    @classmethod
    def constant(cls, ratio: Ratio, at: Float[Array, " n"]) -> "Correction":
        """The same ratio everywhere."""
        none = jnp.zeros((*ratio.shape, SLOPES), ratio.dtype)
        return cls(ratio, at, none, jnp.full(SLOPES, -1))

    def away(
        self,
        coordinates: Float[Array, " n"],
        colour: Int[np.ndarray, " n"],
        channel: Int[np.ndarray, " n"],
        channels: int,
    ) -> Float[Array, "w s"]:
        """How far ``coordinates`` are, along each tangent in each channel: ``colour`` is the tangent of each coordinate, and
        ``channel`` the one in which it is seen, -1 for all."""
        seen = (channel[:, None] == np.arange(channels)) | (channel[:, None] < 0)
        shared = colour[:, None] == self.colour
        far = (coordinates - self.at)[:, None, None]
        return jnp.sum(jnp.where(seen[:, :, None] & shared[:, None], far, 0), axis=0)


def apply(
    light: Float[Array, "pixel w"],
    tangents: Tangents,
    ratio: Float[Array, "pixel w"],
    slope: Float[Array, "pixel w s"],
    away: Float[Array, "w s"],
    colour: Int[Array, " s"],
) -> tuple[Float[Array, "pixel w"], Tangents, Float[Array, "pixel w"]]:
    """The finer model's light and derivatives from the coarser one's, and the ratio of the lights."""
    ratio = ratio * jnp.exp(jnp.sum(slope * away, axis=-1))
    grown = jnp.matmul(slope, jax.nn.one_hot(colour, tangents.shape[-1], dtype=slope.dtype), precision="highest")
    return light * ratio, (tangents + light[..., None] * grown) * ratio[..., None], ratio
