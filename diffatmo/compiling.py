"""How diffatmo's own programs are compiled: the user waits for the compiler, so its speed counts."""

from collections.abc import Callable
from functools import lru_cache
from threading import Thread
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import numpy as np

P = ParamSpec("P")
T = TypeVar("T")

_CPU: dict[str, bool | int | str] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_experimental_ynn_fusion_type": "",
    "xla_cpu_multi_thread_eigen": False,
    "xla_disable_hlo_passes": "cse_barrier_expander",
}
"""XLA's older emitters of loops: the newer ones take twice as long to compile programs of many small formulas, as the models
are, and make them 10 % faster. And no library for products and sums: the models' are too small for it to pay its way, and
without it they run a third faster. And each product on one thread: they are thousands of a few microseconds, which take twice
as long shared out; loops are shared out all the same. And barriers stay until loops are merged, see
:func:`diffatmo.numerics.once`."""

_CPU_FEW_CALLS = _CPU | {"xla_backend_optimization_level": 1}
"""Another 15 % off the time to compile, for up to half as much again to run."""


def _known(options: dict[str, bool | int | str]) -> dict[str, bool | int | str]:
    """``options``, or none on a device or with a version of XLA that they are not for."""
    if jax.default_backend() != "cpu":
        return {}
    try:
        # With a barrier: this compiler has to know what to do with one that stays.
        jax.jit(jax.lax.optimization_barrier, compiler_options=options)(0.0)
    except jax.errors.JaxRuntimeError:
        return {}
    return dict(options)


@lru_cache
def compiler_options() -> dict[str, bool | int | str]:
    """Options for :func:`jax.jit` with which the models compile in about half the time; empty where they are unknown.

    ``jax.jit(function, compiler_options=diffatmo.compiler_options())``; JAX takes options for the outermost ``jit`` only.
    """
    return _known(_CPU)


@lru_cache
def _few_calls() -> dict[str, bool | int | str]:
    return _known(_CPU_FEW_CALLS)


@lru_cache
def outermost(function: Callable[P, T]) -> Callable[P, T]:
    """``function`` compiled quickly, as it runs a few times only. Not for what may be called inside another ``jit``."""
    options: Any = {"compiler_options": _few_calls()}
    compiled: Callable[P, T] = eqx.filter_jit(function, **options)
    return compiled


def compile_ahead(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Thread:
    """Begin to compile :func:`outermost` of ``function`` for arguments like these, in a thread of its own.

    A call after the thread has ended finds the program. Arrays that are not known yet may be ``jax.ShapeDtypeStruct``. Python
    holds its lock while it traces, so that is done here; the compiler does not.
    """

    def known(leaf: Any) -> Any:
        return jax.device_put(np.zeros(leaf.shape, leaf.dtype)) if isinstance(leaf, jax.ShapeDtypeStruct) else leaf

    compiled: Any = outermost(function)
    arguments, options = jax.tree.map(known, (args, kwargs))
    thread = Thread(target=compiled.lower(*arguments, **options).compile)
    thread.start()
    return thread
