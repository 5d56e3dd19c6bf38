"""Losses that let clouds and objects be wrong without bending the sky.

A pixel is as wrong as the root mean square s of its whitened residuals over the channels: a cloud is no outlier in one colour
alone. Its contribution to χ² is n c² ρ(u), u = s² / (σ c)², n channels, instead of n s²:

==========  ==================  ============  =========================================================================
loss        ρ(u)                c             outliers
==========  ==================  ============  =========================================================================
``huber``   u; 2 √u - 1         1.5           pull with a constant force, however far they are (Huber 1964)
``cauchy``  ln(1 + u)           2.5           pull less the farther they are
``tukey``   (1 - (1 - u)³) / 3  4.5           beyond σ c they do not count at all (Beaton & Tukey 1974)
==========  ==================  ============  =========================================================================

Re-weighted by ρ'(u), the residuals have the right gradient, and with ρ itself in the corner of the triangular factor the right
χ²: each step is one of iteratively re-weighted least squares. The scale σ of the residuals comes from their median, which up to
half of the pixels cannot spoil; it is at least one (the stated noise), and falls from stage to stage as the fit gets better.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting._errors import FitError

Squares = Float[Array, "*pixels"]


def _huber(u: Squares) -> tuple[Squares, Squares, Squares]:
    outside = u > 1
    root = jnp.sqrt(jnp.where(outside, u, 1))
    return jnp.where(outside, 2 * root - 1, u), 1 / root, jnp.where(outside, -0.5 / root**3, 0)


def _cauchy(u: Squares) -> tuple[Squares, Squares, Squares]:
    return jnp.log1p(u), 1 / (1 + u), -1 / (1 + u) ** 2


def _tukey(u: Squares) -> tuple[Squares, Squares, Squares]:
    inside = jnp.where(u < 1, 1 - u, 0)
    return (1 - inside**3) / 3, inside**2, -2 * inside


_LOSSES: dict[str, tuple[Callable[[Squares], tuple[Squares, Squares, Squares]], float]] = {
    "huber": (_huber, 1.5),
    "cauchy": (_cauchy, 2.5),
    "tukey": (_tukey, 4.5),
}
"""Name -> ρ, ρ' and ρ'' of u, and c."""

LOSSES = tuple(_LOSSES)
"""Names of the losses."""


class Loss(eqx.Module):
    """A loss at a scale."""

    name: str = eqx.field(static=True)
    scale: Float[Array, ""]
    """σ, in units of the stated noise."""

    def __check_init__(self) -> None:
        if self.name not in _LOSSES:
            raise FitError(f"loss: got {self.name!r}, expected one of {', '.join(LOSSES)}")

    def __call__(self, whitened: Float[Array, "*pixels w"]) -> tuple[Float[Array, "*pixels"], Float[Array, ""]]:
        """The weight of every pixel, and the sum of the loss of all."""
        rho, c = _LOSSES[self.name]
        loss, weight, _ = rho(jnp.mean(whitened**2, axis=-1) / (c * self.scale) ** 2)
        return weight, whitened.shape[-1] * (c * self.scale) ** 2 * jnp.sum(loss)

    def inflation(self, whitened: Float[Array, "*pixels w"], used: Bool[Array, "*pixels"]) -> Float[Array, ""]:
        """Factor from the inverse of the weighted JᵀJ to the covariance.

        Huber 1981, Robust Statistics, eq. 7.6.5: the covariance is mean(ψ²) / mean(ψ')² (JᵀJ)⁻¹ of the unweighted J.
        """
        rho, c = _LOSSES[self.name]
        squares = jnp.mean(whitened**2, axis=-1)
        u = squares / (c * self.scale) ** 2
        _, weight, curvature = rho(u)
        mean = lambda values: jnp.sum(jnp.where(used, values, 0)) / jnp.sum(used)
        slope = mean(weight + 2 * u * curvature / whitened.shape[-1])
        return mean(weight) * mean(weight**2 * squares) / slope**2


def scale(whitened: Float[np.ndarray, "*pixels w"], used: Bool[np.ndarray, "*pixels"]) -> float:
    """σ of the residuals from the median of s² over the pixels, at least 1.

    The median of χ² with n degrees of freedom is n (1 - 2/(9n))³ (Wilson & Hilferty 1931).
    """
    n = whitened.shape[-1]
    squares = np.sum(np.asarray(whitened, float)[used] ** 2, axis=-1)
    return max(1.0, float(np.sqrt(np.median(squares) / (n * (1 - 2 / (9 * n)) ** 3))))
