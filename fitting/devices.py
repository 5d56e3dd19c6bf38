"""Several devices share out the pixels of a fit: those of one machine, or of all processes of ``jax.distributed``.

Everything but the pixels is on every device, and every process takes the same steps: what they exchange are a few rows for each
evaluation, and the radiance of all pixels.

On CPUs a process should have one device, which uses all cores: where ``--xla_force_host_platform_device_count`` gives each
of several processes as many devices as there are cores, XLA's threads can wait for each other for ever.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from fitting._errors import FitError
from fitting.linearisation import AXIS, Linearisation, spread
from fitting.problem import Problem


def mesh_of(devices: Sequence[jax.Device] | None) -> Mesh | None:
    """``devices``, or all that there are; None if that is a single one. Raises :class:`FitError` for anything else."""
    if devices is not None and not (
        isinstance(devices, Sequence) and devices and all(isinstance(device, jax.Device) for device in devices)
    ):
        raise FitError(f"devices: got {devices!r}, expected some of jax.devices()")
    chosen = jax.devices() if devices is None else list(devices)
    return Mesh(np.array(chosen), (AXIS,)) if len(chosen) > 1 else None


def placed(problem: Problem) -> Problem:
    """``problem`` where it is computed."""
    mesh = problem.batch.mesh
    if mesh is None:
        return problem
    arrays, rest = eqx.partition(problem, eqx.is_array)
    everywhere, apart = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec(None, AXIS))

    def put(array: Array, where: NamedSharding) -> Array:
        own = np.asarray(array)
        return jax.make_array_from_callback(own.shape, where, lambda index: own[index])

    return eqx.combine(jax.tree.map(put, arrays, spread(arrays, everywhere, apart)), rest)


def gathered(found: Array, mesh: Mesh | None) -> Array:
    """An array of pixels, or one that all devices have, for the use of this process."""
    if mesh is None:
        return found
    everywhere = jax.jit(lambda x: x, out_shardings=NamedSharding(mesh, PartitionSpec()))(found)
    return jax.device_put(np.asarray(everywhere))


def collected(found: Linearisation, mesh: Mesh | None) -> Linearisation:
    """A linearisation for the use of this process."""
    return Linearisation(*(gathered(part, mesh) for part in found))
