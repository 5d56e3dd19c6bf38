"""The colours of a photo that was fitted, for another sky: its bands, exposure, white balance and purity, from ``fit.json``."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from diffatmo.cli.common import InputError

if TYPE_CHECKING:
    import numpy as np

    from diffatmo.atmosphere import Atmosphere

SAME_NM = 0.5
"""Between a wavelength of the fit and one of the atmosphere."""

STEPS = 60
"""Of the iteration for the purity, each of which leaves 0.8 of the error at most."""

STEEPEST = 0.8
"""Luminance over a channel, times the coefficient, up to which purity grows: from 1 on there is no such pixel, and just below,
light a little less would make the pixel very much darker."""


class Colours(NamedTuple):
    """How a camera saw the light."""

    wavelengths: "np.ndarray"
    """nm."""
    response: "np.ndarray"
    """(channel, wavelength)."""
    factor: "np.ndarray"
    """Exposure and white balance of each channel."""
    saturation: float
    """Coefficient of the purity (``chroma`` in :mod:`fitting.nuisances`)."""
    encoded: bool
    """Whether the photo had the transfer function of sRGB, about; then 1 is white."""

    def develop(self, radiance: "np.ndarray") -> "np.ndarray":
        """Linear pixels of the photo for light at its wavelengths, (height, width, n) -> (height, width, 3)."""
        import numpy as np

        from diffatmo.color import LUMINANCE

        light = np.maximum(radiance @ self.response.T * self.factor, 0).astype(float)
        lit, s = light > 0, self.saturation
        wanted = np.log(np.where(lit, light, 1))
        found, largest = wanted, STEEPEST / s if s > 0 else np.inf
        for _ in range(STEPS if s else 0):
            luminance = np.where(lit, np.exp(found), 0) @ np.asarray(LUMINANCE, float)
            share = luminance[..., None] * np.exp(-found)
            off = found - wanted - s * (1 - np.minimum(share, largest))
            # Newton's step where colours are made paler; where they are made purer the slope is between 0.2 and 1.
            found = found - off / (1 + max(-s, 0) * share)
        return np.where(lit, np.exp(found), 0).astype(np.float32)


def read(path: Path, air: "Atmosphere") -> Colours:
    """The colours of the first photo of a fit, for an atmosphere at its wavelengths."""
    import numpy as np

    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        found = [image["colours"] for image in record["images"] if image["colours"] is not None]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: expected the fit.json of a photo, as this version of diffatmo writes it") from error
    if not found:
        raise InputError(f"{path}: none of its images is a photo, whose channels are bands; leave --colours out")
    said: dict[str, Any] = found[0]
    colours = Colours(
        np.asarray(said["wavelengths_nm"], dtype=float),
        np.asarray(said["response"], dtype=float),
        np.asarray(said["factor"], dtype=float),
        float(said["saturation"]),
        bool(said["encoded"]),
    )
    own = np.asarray(air.wavelengths, dtype=float)
    if own.shape != colours.wavelengths.shape or np.abs(own - colours.wavelengths).max() > SAME_NM:
        needed = ", ".join(f"{nm:g}" for nm in colours.wavelengths)
        raise InputError(
            f"--colours: the atmosphere is not at the wavelengths of the fit, {needed} nm; give its atmosphere.toml"
        )
    return colours
