"""A sky is a tree of arrays: it passes through jit, and many atmospheres are one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_gradients import COMPILE_FAST, MODELS

from diffatmo.atmosphere import earth


@pytest.mark.parametrize("name", ["bruneton", "hillaire", "raymarch"])
def test_many_skies_are_each_on_its_own(name):
    """Skies of two atmospheres, made together and asked together, against one of them made and asked alone."""
    model = MODELS[name]
    hazy = eqx.tree_at(
        lambda air: (air.mie_scattering, air.mie_g), earth(), (5 * earth().mie_scattering, jnp.asarray(0.6))
    )
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), earth(), hazy)
    rays = {"altitude": jnp.float32(0.5), "mu": jnp.float32(0.4), "mu_s": jnp.float32(0.6), "nu": jnp.float32(0.3)}
    make = jax.jit(jax.vmap(model.sky), compiler_options=COMPILE_FAST)
    ask = jax.jit(jax.vmap(lambda sky: sky.path(**rays)), compiler_options=COMPILE_FAST)
    together = ask(make(both))
    alone = jax.jit(lambda air: model.sky(air).path(**rays), compiler_options=COMPILE_FAST)(hazy)
    for one, many in zip(alone, together, strict=True):
        np.testing.assert_allclose(many[1], one, rtol=1e-5)
