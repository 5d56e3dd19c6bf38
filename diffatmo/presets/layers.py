"""Densities as the two layers of five numbers of Bruneton 2017, which other renderers have adopted.

A layer is (width, exp_term, exp_scale, linear_term, constant_term); lengths are in any unit.
"""

import math
from collections.abc import Sequence

from diffatmo.presets.fields import PresetError

Layer = tuple[float, float, float, float, float]

NOTHING: Layer = (0.0, 0.0, 0.0, 0.0, 0.0)

PRINTED = 1e-4
"""Relative error that the numbers of a layer may have: renderers print six digits."""


def exponential(scale_height: float) -> Layer:
    """exp(-h / ``scale_height``)."""
    return (0.0, 1.0, -1 / scale_height, 0.0, 0.0)


def scale_height(key: str, layers: Sequence[Layer]) -> float:
    """The scale height of ``layers``, or :class:`PresetError` if they are no exponential."""
    below, (_, term, scale, linear, constant) = layers[:-1], layers[-1]
    if term != 1 or linear or constant or scale >= 0 or any(layer[0] > 0 for layer in below):
        raise PresetError(f"{key}: got {list(layers)}, expected one layer exp(-h / scale height)")
    return -1 / scale


def tent(center: float, half_width: float) -> list[Layer]:
    """1 at altitude ``center``, falling to 0 at ``center`` ± ``half_width``."""
    rising = 1 / half_width
    return [(center, 0.0, 0.0, rising, 1 - center * rising), (0.0, 0.0, 0.0, -rising, 1 + center * rising)]


def center_and_half_width(key: str, layers: Sequence[Layer]) -> tuple[float, float]:
    """Those of the tent in ``layers``, or :class:`PresetError` if they are none."""
    if len(layers) == 2 and layers[1][3] < 0:
        center, half_width = layers[0][0], -1 / layers[1][3]
        pairs = zip(tent(center, half_width), layers, strict=True)
        if all(
            math.isclose(a, b, rel_tol=PRINTED, abs_tol=PRINTED / (half_width if i == 3 else 1))
            for wanted, got in pairs
            for i, (a, b) in enumerate(zip(wanted, got, strict=True))
            if i > 0
        ):
            return center, half_width
    raise PresetError(f"{key}: got {list(layers)}, expected two linear layers that rise to 1 and fall back as fast")
