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

STEPS = 30
"""Of the iteration for the purity, which at least halves the error each time."""


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

        light = np.maximum(radiance @ self.response.T * self.factor, 0)
        pixel = light
        for _ in range(STEPS if self.saturation else 0):
            share = (pixel @ np.asarray(LUMINANCE))[..., None] / np.maximum(pixel, 1e-30)
            pixel = light * np.exp(self.saturation * (1 - np.minimum(share, 10)))
        return np.asarray(pixel, dtype=np.float32)


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
