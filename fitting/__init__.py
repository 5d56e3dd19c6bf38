"""Which atmosphere made this sky? Least squares from images to parameters, with error bars.

::

    observation = fitting.observe(pixels, camera=camera, altitude=0.1, sun=sun.direction(zenith=0.7, azimuth=0.0))
    result = fitting.fit([observation], init=earth(), free=["rayleigh_scattering", "mie_scattering", "mie_g"])
    result                                      # the table, in a notebook
    result.predict(scene).standard_error        # the same air elsewhere, with error bars
    fitting.report.write(result, "out")
"""

from fitting import planning, priors, report
from fitting._errors import FitError
from fitting.findings import Estimate, Minimum, Profile
from fitting.observation import Observation, observe
from fitting.parameters import FREE_FIELDS
from fitting.prediction import Prediction
from fitting.priors import Prior
from fitting.profiles import profile
from fitting.result import FitResult
from fitting.search import Step
from fitting.uncertainty import fit

__all__ = [
    "FREE_FIELDS",
    "Estimate",
    "FitError",
    "FitResult",
    "Minimum",
    "Observation",
    "Prediction",
    "Prior",
    "Profile",
    "Step",
    "fit",
    "observe",
    "planning",
    "priors",
    "profile",
    "report",
]
