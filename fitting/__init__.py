"""Which atmosphere made this sky? Least squares from images to parameters, with error bars.

::

    observation = fitting.observe(pixels, camera=camera, altitude=0.1, sun=sun.direction(zenith=0.7, azimuth=0.0))
    result = fitting.fit([observation], init=earth(), free=["rayleigh_scattering", "mie_scattering", "mie_g"])
    fitting.report.write(result, "out")
"""

from fitting import planning, report
from fitting._errors import FitError
from fitting.observation import Observation, observe
from fitting.parameters import FREE_FIELDS
from fitting.solve import Step
from fitting.uncertainty import Estimate, FitResult, fit

__all__ = [
    "FREE_FIELDS",
    "Estimate",
    "FitError",
    "FitResult",
    "Observation",
    "Step",
    "fit",
    "observe",
    "planning",
    "report",
]
