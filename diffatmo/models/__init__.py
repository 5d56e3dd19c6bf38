"""Models of the sky: one interface (:mod:`diffatmo.models.base`), several ways to the same radiance."""

from diffatmo.models.base import Model, Path, Ray, Sky, View
from diffatmo.models.bruneton import Bruneton
from diffatmo.models.hillaire import Hillaire
from diffatmo.models.moments import Moments
from diffatmo.models.pathtrace import PathTrace
from diffatmo.models.raymarch import RayMarch

MODELS: dict[str, type[Model]] = {
    "moments": Moments,
    "bruneton": Bruneton,
    "hillaire": Hillaire,
    "raymarch": RayMarch,
    "pathtrace": PathTrace,
}
"""Models by the name the command line takes."""

__all__ = ["MODELS", "Bruneton", "Hillaire", "Model", "Moments", "Path", "PathTrace", "Ray", "RayMarch", "Sky", "View"]
