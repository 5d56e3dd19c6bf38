"""Pixels that a camera or a file could not show as bright as they were."""

import numpy as np
from jaxtyping import Bool, Float

LEAST = 9
"""Pixels at the largest value that make a plateau."""


def clipped(
    pixels: Float[np.ndarray, "height width w"], *, saturation: float | None = None
) -> Bool[np.ndarray, "height width"]:
    """Pixels of which a channel is clipped: at ``saturation`` and above, or on a plateau at the channel's largest value.

    A smooth maximum has, in a picture of discrete values, about as many pixels at its top value as at the next ones; a
    clipped one has many more. Channels may be clipped at different values, by a white balance that came after. An infinite
    pixel is clipped: that is what half-precision files have where the sun was too bright for them.
    """
    infinite = np.asarray(np.isposinf(pixels).any(axis=-1))
    if saturation is not None:
        return infinite | (pixels >= saturation).any(axis=-1)
    plateau = np.zeros(pixels.shape[:2], dtype=bool)
    for channel in np.moveaxis(pixels, -1, 0):
        finite = channel[np.isfinite(channel)]
        peak = finite.max(initial=0)
        counts = np.unique_counts(finite[finite >= 0.9 * peak]).counts
        if peak > 0 and counts[-1] >= LEAST and counts[-1] > 3 * counts[-4:-1].max(initial=0):
            plateau |= channel >= 0.985 * peak
    return infinite | plateau
