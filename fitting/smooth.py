"""Random smooth functions of direction, image by image: the forms that errors of a model are given."""

from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo.numerics import array
from fitting.batch import Batch

SAMPLE = 4096
"""Pixels of an image that decide on which functions are orthogonal there."""


def _monomials(degree: int) -> list[tuple[int, int, int]]:
    """Powers of x, y and z; on the sphere a square of z is none that the others have not."""
    up_to = range(degree + 1)
    return [(i, j, k) for i in up_to for j in up_to[: degree + 1 - i] for k in range(min(2, degree + 1 - i - j))]


class Fields(eqx.Module):
    """Polynomials of the view direction, orthogonal over the used pixels of each image, of mean square one there.

    A sum of b of them with independent coefficients of variance s²/b is a random smooth function on the sky of variance s².
    """

    degree: int = eqx.field(static=True)
    centre: Float[Array, "image 3"]
    """Polynomials are of the direction less this one, that of narrow images' middle: of the direction itself all look alike."""
    coefficient: Float[Array, "image b b"]

    @classmethod
    def of(cls, batch: Batch, degree: int) -> Self:
        """Those up to ``degree``."""
        centres, coefficients = [], []
        for directions, used in zip(np.asarray(batch.directions), np.asarray(batch.used), strict=True):
            own = np.flatnonzero(used)
            own = own[np.linspace(0, own.size - 1, min(own.size, SAMPLE)).astype(int)]
            towards = directions[own].astype(np.float64).mean(axis=1)
            centre = towards.mean(axis=0)
            values = np.prod((towards - centre)[:, None] ** np.array(_monomials(degree), float), axis=-1)
            length = np.linalg.norm(values, axis=0)
            scale = np.where(length > 0, length, 1)
            # Where there are fewer pixels than functions, the last ones are zero.
            _, singular, right = np.linalg.svd(values / scale, full_matrices=False)
            kept = singular > 1e-6 * singular[0]
            coefficient = np.zeros((len(scale), len(scale)))
            coefficient[:, : kept.sum()] = (right[kept].T / singular[kept]) * np.sqrt(own.size) / scale[:, None]
            centres.append(centre)
            coefficients.append(coefficient)
        return cls(degree, array(np.stack(centres)), array(np.stack(coefficients)))

    def at(
        self,
        directions: Float[Array, "pixel part 3"],
        centre: Float[Array, "3"],
        coefficient: Float[Array, "b b"],
    ) -> Float[Array, "pixel b"]:
        """The functions of the image with this ``centre`` and ``coefficient``."""
        apart = jnp.mean(directions, axis=1) - centre
        powers = [jnp.ones_like(apart)]
        for _ in range(self.degree):
            powers.append(powers[-1] * apart)
        values = [powers[i][:, 0] * powers[j][:, 1] * powers[k][:, 2] for i, j, k in _monomials(self.degree)]
        return jnp.stack(values, axis=-1) @ coefficient
