"""A sky is a tree of arrays: it passes through jit, many atmospheres are one, and products keep their precision."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params
from test_gradients import COMPILE_FAST, MODELS

from diffatmo.atmosphere import earth
from diffatmo.models import Moments


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


def products(jaxpr):
    """The precisions of all products of matrices in a program and in the programs inside."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation.params["precision"]
        for inner in jaxprs_in_params(equation.params):
            yield from products(inner)


@pytest.mark.parametrize("name", ["moments", "bruneton", "hillaire", "raymarch"])
def test_products_are_not_rounded(name):
    """As accelerators do by default, to 10 bits: every one asks for the precision of its numbers; derivatives keep it."""
    model = {"moments": Moments(), **MODELS}[name]
    view, sun = jnp.array([0.6, 0.0, 0.8]), jnp.array([0.0, 0.6, 0.8])

    def light(air):
        sky = model.sky(air)
        rays = {"altitude": jnp.array(0.5), "mu": view[2], "mu_s": sun[2], "nu": jnp.array(0.64)}
        return sky.view(altitude=0.5, sun=sun).radiance(view=view), sky.path(**rays)

    found = list(products(jax.make_jaxpr(light)(earth()).jaxpr))
    assert found
    assert {precision[0] if precision else None for precision in found} == {jax.lax.Precision.HIGHEST}
