"""The costly part of a fit: the model and its forward derivatives in all pixels, reduced to a few rows for each image.

*Colours.* Wavelengths do not mix, so all numbers of a spectral parameter share one tangent, whose
channel w is the derivative with respect to number w alone (channels that are bands do mix them: then each number has a tangent
of its own). Images do not mix either, so a component of an offset shares one
tangent among all images, and the sky stays as it is along it. Exposures and pedestals need no tangent at all. Nine parameters
at three wavelengths thus cost as many forward derivatives as there are *fields*, not numbers.

*Rows.* Of all pixels of an image and channel, least squares needs no more than the triangular factor of the columns

    [T L 1 r] / sigma,

tangents T, radiance L and residual r. χ² and all its derivatives with respect to ``y``, for other exposures and pedestals as
well, are sums over the few rows of that factor as they are over the pixels (:mod:`fitting.least_squares`). Unlike JᵀJ it does
not square the condition number, which in float32 decides whether a weakly determined parameter is seen at all.

*Tiles.* Each image is gone through in tiles, and each tile is reduced to rows at once: of the derivatives no more than one tile
is ever held, however many pixels there are. On several devices each has its share of the pixels of every image, and the
skies are solved on all; what they hand to each other are the rows.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec
from jaxtyping import Array, Float, Int

from diffatmo.atmosphere import Atmosphere
from diffatmo.models import Sky
from fitting.batch import PIXEL_FIELDS, Views
from fitting.correction import apply
from fitting.nuisances import AEROSOL, SHADING
from fitting.parameters import Coordinates
from fitting.problem import Linear, Predicted, Problem, hazier, seen

T = TypeVar("T")
AXIS = "pixel"
"""Name of the axis of devices among which the pixels are shared out."""

Tile = dict[str, Array]
"""What belongs to the pixels of a tile, by name."""


class Linearisation(NamedTuple):
    """What least squares needs to know of all pixels, near one point."""

    rows: Float[Array, "image w k k"]
    """Triangular factors of [tangents, radiance, 1, residual] / sigma. A tangent for each colour of the parameters, then for
    each component of the offsets that moves any image, then for each direction along which a correction changes. A robust loss
    weights the pixels besides."""
    linear: Linear
    """The linear nuisances for which the residuals, and the weights of a robust loss, are."""
    beyond: Float[Array, ""]
    """What the robust loss of these residuals exceeds their weighted squares by."""
    pushes: Float[Array, "image w b k"]
    """The columns, summed with each smooth field times the light that the correction adds, or all light where there is none:
    what errors of such a form do."""
    radiance: Predicted
    bad: Int[Array, "image 2"]
    """Used pixels whose radiance or whose derivatives are not finite."""


def linearise(x: Coordinates, linear: Linear, problem: Problem) -> Linearisation:
    """The model and its derivatives at ``x``, with residuals for the nuisances ``linear``."""
    if problem.batch.mesh is None:
        return _linearise(x, linear, problem)
    everywhere, apart = PartitionSpec(), PartitionSpec(None, AXIS)
    arrays, rest = eqx.partition(problem, eqx.is_array)
    out: Any = Linearisation._make((everywhere, everywhere, everywhere, everywhere, apart, everywhere))
    return jax.shard_map(
        lambda x, linear, arrays: _together(_linearise(x, linear, eqx.combine(arrays, rest))),
        mesh=problem.batch.mesh,
        in_specs=(everywhere, everywhere, spread(arrays, everywhere, apart)),
        out_specs=out,
        check_vma=False,
    )(x, linear, arrays)


def spread(problem: Problem, everywhere: T, apart: T) -> Any:
    """``apart`` for every array of ``problem`` that has pixels, ``everywhere`` for any other."""
    of_correction = lambda p: [] if problem.correction is None else [p.correction.ratio, p.correction.slope]
    names = problem.batch.pixel_fields
    where = lambda p: [p.weight, *of_correction(p), *(getattr(p.batch, name) for name in names)]
    marks = jax.tree.map(lambda _: everywhere, problem)
    return eqx.tree_at(
        where, marks, replace_fn=lambda leaf: leaf if leaf is None else apart, is_leaf=lambda x: x is None
    )


def _together(part: Linearisation) -> Linearisation:
    """What a device found, with what the others did."""
    rows = jax.lax.all_gather(part.rows, AXIS, axis=2, tiled=True)
    total = lambda value: jax.lax.psum(value, AXIS)
    return part._replace(
        rows=jax.lax.map(_triangles, rows), beyond=total(part.beyond), pushes=total(part.pushes), bad=total(part.bad)
    )


def _triangles(columns: Float[Array, "w row k"]) -> Float[Array, "w k k"]:
    """The triangular factor of each channel, one after the other: jaxlib hands a batch of them to the threads that the devices
    of a machine share, and waits; where every thread waits so, none is left to do it."""
    return jax.lax.map(lambda channel: jnp.linalg.qr(channel, mode="r"), columns)


def _linearise(x: Coordinates, linear: Linear, problem: Problem) -> Linearisation:
    batch = problem.batch
    factor, pedestal = batch.exposure(linear), batch.nuisances.pedestal(linear)

    def add(carry: tuple[Array, ...], tile: Tile) -> tuple[tuple[Array, ...], Predicted]:
        rows, beyond, pushes, bad = carry
        radiance, tangents, used = tile["radiance"], tile["tangents"], tile["used"][:, None]
        off = jnp.where(used, tile["factor"] * radiance + tile["pedestal"] - tile["measured"], 0) * tile["weight"]
        columns = jnp.concatenate([tangents, jnp.stack([radiance, jnp.ones_like(radiance)], axis=-1)], axis=-1)
        columns = jnp.where(used[..., None], columns, 0) * tile["weight"][..., None]
        columns = jnp.concatenate([columns, off[..., None]], axis=-1)
        if problem.fields is not None:
            fields = problem.fields.at(tile["directions"], tile["centre"], tile["coefficient"])
            added = columns[..., -3]
            if "correction" in tile:
                added = added * (1 - 1 / tile["correction"])
            pushes = pushes + jnp.einsum("pw,pb,pwk->wbk", added, fields, columns)
        if problem.loss is not None:
            robust, total = problem.loss(off)
            columns = columns * jnp.sqrt(robust)[:, None, None]
            beyond = beyond + total - jnp.sum(columns[..., -1] ** 2)
        rows = _triangles(jnp.concatenate([rows, jnp.swapaxes(columns, 0, 1)], axis=1))
        lost = [~jnp.isfinite(values).reshape(len(used), -1).all(axis=1) for values in (radiance, tangents)]
        bad = bad + jnp.sum(used & jnp.stack(lost, axis=-1), axis=0)
        return (rows, beyond, pushes, bad), radiance

    tangents = int(problem.colours()[0].max()) + 1 + len(batch.nuisances.moving)
    if problem.correction is not None:
        tangents += len(problem.correction.along)
    channels, size, dtype = batch.measured.shape[-1], tangents + 3, batch.measured.dtype
    forms = 0 if problem.fields is None else problem.fields.coefficient.shape[-1]
    empty = (
        jnp.zeros((channels, size, size), dtype),
        jnp.zeros((), dtype),
        jnp.zeros((channels, forms, size), dtype),
        jnp.zeros(2, int),
    )
    more = {"factor": factor, "pedestal": pedestal}
    if problem.fields is not None:
        more |= {"centre": problem.fields.centre, "coefficient": problem.fields.coefficient}
    (rows, beyond, pushes, bad), radiance = visit(x, problem, empty, add, more)
    return Linearisation(rows, linear, jnp.sum(beyond), pushes, radiance, bad)


class Derivatives(NamedTuple):
    """The radiance of all pixels, and its derivatives along the tangents of :class:`Linearisation`."""

    radiance: Predicted
    tangents: Float[Array, "image pixel w colour"]


def derivatives(x: Coordinates, problem: Problem) -> Derivatives:
    """Those of all pixels, held at once: for few of them."""

    def keep(carry: tuple[()], tile: Tile) -> tuple[tuple[()], Derivatives]:
        return carry, Derivatives(tile["radiance"], tile["tangents"])

    return visit(x, problem, (), keep, {})[1]


def visit(
    x: Coordinates,
    problem: Problem,
    empty: Any,
    add: Callable[[Any, Tile], tuple[Any, Any]],
    more: dict[str, Float[Array, "image ..."]],
) -> tuple[Any, Any]:
    """Go through the tiles of every image, beginning with ``empty``, and hand each to ``add``.

    A tile has the pixel fields of the batch, ``weight``, ``radiance`` and ``tangents``, and the image's part of ``more``. Gives
    what ``add`` gives first, after the last tile of each image, and what it gives second, pixels of an image after another.
    """
    batch = problem.batch
    coordinates, moved = problem.parts(x)
    colour, _ = problem.colours()
    seeds = jnp.asarray(colour == np.arange(colour.max() + 1)[:, None], dtype=coordinates.dtype)
    air, of_air = _push(problem.parameters.atmosphere, (coordinates,), (seeds,))
    # What moves the view comes first among the offsets, shading next, and last a free aerosol.
    apart = AEROSOL in batch.nuisances.moving
    turning = sum(component < SHADING.start for component in batch.nuisances.moving)
    each = jnp.broadcast_to(jnp.eye(turning, moved.shape[1], dtype=moved.dtype)[:, None], (turning, *moved.shape))
    views, of_views = _push(batch.views, (moved,), (each,)) if turning else (batch.views(moved), None)
    sky, of_sky = (None, None) if apart else _push(problem.sky, (air,), (of_air,))
    tiled = lambda values: values.reshape(len(values), batch.tiles, values.shape[1] // batch.tiles, *values.shape[2:])
    pixels = {name: tiled(getattr(batch, name)) for name in PIXEL_FIELDS if name != "directions"}
    pixels |= {"weight": tiled(problem.weight), "directions": tiled(views.directions)}
    if shaded := batch.shading.shape[-1]:
        pixels["modulation"] = tiled(batch.modulation(moved))
    if (correction := problem.correction) is not None:
        pixels |= {"correction": tiled(correction.ratio), "slope": tiled(correction.slope)}
        steps = correction.steps(x)
    if of_views is not None:
        # Images first, tiles next, then the components.
        pixels["turned"] = jnp.moveaxis(jax.vmap(tiled)(of_views.directions), 0, 2)
        more = more | {"displaced": jnp.swapaxes(of_views.sun, 0, 1)}

    def of_image(image: tuple[Views, dict[str, Array], dict[str, Array]]) -> tuple[Any, Any]:
        here, own, pixels = image
        its_sky, of_its_sky = sky, of_sky
        if here.aerosol is not None:
            its_sky, of_its_sky = _hazier_sky(problem, air, of_air, here.aerosol)
        look = lambda sky, sun: sky.view(altitude=here.altitude, sun=sun)
        view, of_view = _push(lambda sky: look(sky, here.sun), (its_sky,), (of_its_sky,))
        displaced = None
        if "displaced" in own:
            _, displaced = _push(lambda sun: look(its_sky, sun), (here.sun,), (own["displaced"],))

        def of_tile(carry: Any, tile: Tile) -> tuple[Any, Any]:
            directions = tile["directions"]
            light, tangents = _push(lambda view: seen(view, directions, here.response), (view,), (of_view,))
            if tangents is None:
                # A model that makes no use of what is free.
                tangents = jnp.zeros((len(seeds) + apart, *light.shape), light.dtype)
            if displaced is not None:
                look_at = lambda view, directions: seen(view, directions, here.response)
                _, turns = _push(look_at, (view, directions), (displaced, tile["turned"]))
                tangents = jnp.concatenate([tangents[: len(seeds)], turns, tangents[len(seeds) :]])
            tangents = jnp.moveaxis(tangents, 0, -1)
            if shaded:
                before, after = jnp.split(tangents, [tangents.shape[-1] - apart], axis=-1)
                tangents = jnp.concatenate([before, light[..., None] * tile["shading"], after], axis=-1)
                light, tangents = light * tile["modulation"], tangents * tile["modulation"][..., None]
            if correction is not None:
                light, tangents, tile["correction"] = apply(light, tangents, tile["correction"], tile["slope"], steps)
            return add(carry, tile | own | {"radiance": light, "tangents": tangents})

        return jax.lax.scan(of_tile, empty, pixels)

    # Directions are among the pixels.
    places = views._replace(directions=jnp.zeros_like(views.directions[:, :0]))
    carry, found = jax.lax.map(of_image, (places, more, pixels))
    return carry, jax.tree.map(lambda values: values.reshape(len(values), -1, *values.shape[3:]), found)


def _hazier_sky(problem: Problem, air: Atmosphere, of_air: Any, log: Array) -> tuple[Sky, Any]:
    """The sky of an image with more aerosol, and its derivatives along those of the air, and last along the aerosol's."""
    none = jax.tree.map(lambda leaf: jnp.zeros_like(leaf[:1]), of_air)
    along_air = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), of_air, none)
    count = len(jax.tree.leaves(along_air)[0])
    along_aerosol = jnp.zeros(count, log.dtype).at[-1].set(1)
    return _push(lambda air, log: problem.sky(hazier(air, log)), (air, log), (along_air, along_aerosol))


def _push(function: Callable[..., T], at: tuple[Any, ...], along: tuple[Any, ...]) -> tuple[T, Any]:
    """``function`` of ``at``, and its derivatives along each of a number of tangents, their first axis."""
    both = lambda *tangents: eqx.filter_jvp(function, at, tangents)
    pushed: tuple[T, Any] = eqx.filter_vmap(both, out_axes=(None, eqx.if_array(0)))(*along)
    return pushed
