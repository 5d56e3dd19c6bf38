"""Which atmosphere made this sky? A differentiable sky model in JAX.

The names below are the public interface. They are imported when first used, so that ``import diffatmo`` costs nothing
and ``diffatmo --help`` answers at once.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffatmo import (
        atmosphere,
        bands,
        brackets,
        camera,
        color,
        comparison,
        constants,
        ephemeris,
        exif,
        export,
        geometry,
        horizon,
        imageio,
        models,
        numerics,
        phase,
        presets,
        raw,
        render,
        scan,
        scene,
        skymask,
        spectrum,
        sun,
        transmittance,
    )
    from diffatmo.atmosphere import Atmosphere, AtmosphereError, earth, load, mars, save
    from diffatmo.camera import Camera, Equirectangular, Fisheye, Pinhole
    from diffatmo.compiling import compiler_options
    from diffatmo.imageio import ImageError
    from diffatmo.models import Bruneton, Hillaire, Model, Moments, PathTrace, RayMarch, Sky, View
    from diffatmo.render import Scene

__version__ = "0.1.0"

_HOME = {
    "Atmosphere": "atmosphere",
    "AtmosphereError": "atmosphere",
    "Bruneton": "models",
    "Camera": "camera",
    "Equirectangular": "camera",
    "Fisheye": "camera",
    "Hillaire": "models",
    "ImageError": "imageio",
    "Model": "models",
    "Moments": "models",
    "PathTrace": "models",
    "Pinhole": "camera",
    "RayMarch": "models",
    "Scene": "render",
    "Sky": "models",
    "View": "models",
    "compiler_options": "compiling",
    "earth": "atmosphere",
    "load": "atmosphere",
    "mars": "atmosphere",
    "save": "atmosphere",
}
"""Public class or function -> the module it lives in; every other public name is a module."""

__all__ = [
    "Atmosphere",
    "AtmosphereError",
    "Bruneton",
    "Camera",
    "Equirectangular",
    "Fisheye",
    "Hillaire",
    "ImageError",
    "Model",
    "Moments",
    "PathTrace",
    "Pinhole",
    "RayMarch",
    "Scene",
    "Sky",
    "View",
    "__version__",
    "atmosphere",
    "bands",
    "brackets",
    "camera",
    "color",
    "comparison",
    "compiler_options",
    "constants",
    "earth",
    "ephemeris",
    "exif",
    "export",
    "geometry",
    "horizon",
    "imageio",
    "load",
    "mars",
    "models",
    "numerics",
    "phase",
    "presets",
    "raw",
    "render",
    "save",
    "scan",
    "scene",
    "skymask",
    "spectrum",
    "sun",
    "transmittance",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"diffatmo.{_HOME[name]}"), name)
    if name in __all__:
        return import_module(f"diffatmo.{name}")
    raise AttributeError(f"module 'diffatmo' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
