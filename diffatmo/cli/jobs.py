"""A fit ready to run, of what the command line and a scene file say: images read, names checked, usual choices made."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from diffatmo._names import did_you_mean
from diffatmo.cli import photo, scans
from diffatmo.cli.common import InputError, printable, read_atmosphere
from diffatmo.cli.images import View, observe, observe_photo, open_image, stated
from diffatmo.cli.scenefile import FREE, MODELS, FitSpec, ImageSpec

if TYPE_CHECKING:
    from diffatmo.atmosphere import Atmosphere
    from fitting import Observation, Prior
    from fitting.parameters import Parameters

MAX_STEPS = 100


@dataclass(frozen=True)
class Job:
    """A fit ready to run: every image is read, every name is checked."""

    observations: "list[Observation]"
    init: "Atmosphere"
    truth: "Atmosphere | None"
    free: tuple[str, ...]
    tie: Mapping[str, str]
    priors: "list[Prior]"
    loss: str | None
    model: str
    refine: bool
    max_steps: int
    starts: int | None
    profile: tuple[str, ...]
    photos: bool = False
    assumed: tuple[str, ...] = ()
    """What was taken from photos or from experience, in words."""
    views: tuple[View, ...] = ()
    """Of each photo, as it is looked at."""


class Choice(NamedTuple):
    """What is fitted, whatever the images."""

    init: "Atmosphere"
    free: tuple[str, ...]
    tie: Mapping[str, str]
    priors: "list[Prior]"
    profile: tuple[str, ...]


def choose(
    spec: FitSpec,
    init: "Atmosphere",
    free: Sequence[str],
    tie: Mapping[str, str],
    usual: "Callable[[Parameters], list[Prior]] | None" = None,
) -> Choice:
    """What ``spec`` says, checked, with ``free``, ``tie`` and the ``usual`` priors where it says nothing."""
    from fitting import priors
    from fitting.parameters import select

    free = tuple(free if spec.free is None else spec.free)
    tie = {name: kind for name, kind in tie.items() if name == "mie" or name in free} if spec.tie is None else spec.tie
    parameters = select(init, free, tie)
    known = [prior for table in spec.priors or () for prior in make_priors(table, parameters)]
    if spec.priors is None and usual is not None:
        known = usual(parameters)
    priors.collect(known, parameters)
    return Choice(init, free, tie, known, check_profile(spec.profile or (), parameters))


def prepare(spec: FitSpec) -> Job:
    """Read all that ``spec`` names."""
    from diffatmo.atmosphere import dumps
    from fitting import priors

    if any(scans.is_scan(file) for image in spec.images for file in image.files):
        return prepare_scans(spec)
    if spec.init is not None:
        # What is wrong with the fit itself is found before any image is read.
        chosen = choose(spec, read_atmosphere(spec.init), FREE, {})
    opened = [open_image(image, may_be_photo=spec.init is None) for image in spec.images]
    # Of photos the channels are bands, unless an atmosphere says which wavelengths they shall be.
    photos = spec.init is None and bool(opened) and all(image.photo for image in opened)
    if photos:
        pressure, pressure_error = photo.pressure(opened[0].image)
        usual = lambda parameters: priors.typical(parameters, pressure_error=pressure_error)
        chosen = choose(spec, photo.start(pressure), photo.FREE, photo.TIE, usual)
    elif spec.init is None:
        chosen = choose(spec, read_atmosphere("earth"), FREE, {})
    seen = [
        observe_photo(image, name) if photos else observe(image, name, chosen.init)
        for image, name in zip(opened, image_names(spec.images), strict=True)
    ]
    # Images of different atmospheres have no truth in common.
    truths = {dumps(truth): truth for truth in (image.truth for image in seen) if truth is not None}
    model = spec.model or MODELS[0]
    return Job(
        observations=[image.observation for image in seen],
        init=chosen.init,
        truth=next(iter(truths.values())) if len(truths) == 1 else None,
        free=chosen.free,
        tie=chosen.tie,
        priors=chosen.priors,
        loss=spec.loss or (photo.LOSS if photos else None),
        model=model,
        # A finer model would correct what is not wrong in images that the model itself has made, or what a photo cannot show.
        refine=not photos and any(image.model != model for image in seen),
        photos=photos,
        assumed=tuple(f"{image.observation.name}: {line}" for image in seen for line in image.assumed),
        views=tuple(image.view for image in seen if image.view is not None),
        max_steps=spec.max_steps or MAX_STEPS,
        starts=spec.starts,
        profile=chosen.profile,
    )


def prepare_scans(spec: FitSpec) -> Job:
    """The same for measured spectra."""
    from diffatmo import scan
    from fitting import priors

    for image in spec.images:
        if not scans.is_scan(image.file):
            raise InputError(f"{image.file}: an image among scans, expected all to be spectra, or none")
        if image.others:
            raise InputError(f"{image.file}: a scan in a bracket, expected pictures")
        for key in image.options:
            if key not in scans.KEYS:
                raise InputError(
                    f"{key}: {image.file} is a scan, which says itself where it looks and where the sun is; leave it out"
                )
    if spec.init is not None:
        raise InputError(
            f"init: a scan is fitted from a start of its own, at {len(scans.NODES)} wavelengths; leave it out"
        )
    names = image_names(spec.images)
    read, observations = [], []
    for image, name in zip(spec.images, names, strict=True):
        try:
            read.append(scan.read(image.file))
        except scan.ScanError as error:
            raise InputError(str(error)) from error
        try:
            observations.append(scans.observe(read[-1], image.options, stated(image.options), name))
        except ValueError as error:
            raise InputError(f"{image.file}: {str(error).removeprefix(f'{name}: ')}") from error
    chosen = choose(spec, scans.start(read[0]), scans.FREE, scans.TIE, priors.typical)
    return Job(
        observations=observations,
        init=chosen.init,
        truth=None,
        free=chosen.free,
        tie=chosen.tie,
        priors=chosen.priors,
        loss=spec.loss,
        model=spec.model or MODELS[0],
        refine=False,
        max_steps=spec.max_steps or MAX_STEPS,
        starts=spec.starts,
        profile=chosen.profile,
        photos=True,
        assumed=tuple(
            f"{name}: {line}" for spectra, name in zip(read, names, strict=True) for line in scans.assumed(spectra)
        ),
    )


def check_profile(names: Sequence[str], parameters: "Parameters") -> tuple[str, ...]:
    """``names``, each of a number of the fit, before it begins."""
    from fitting.quantities import quantities

    wavelengths = [float(nm) for nm in parameters.init.wavelengths]
    fields = [*parameters.fields, *parameters.derived]
    known = [*fields, *(quantity.name for quantity in quantities(fields, wavelengths))]
    for name in names:
        if name not in known:
            hint = did_you_mean(name, [*known]) or ";"
            raise InputError(
                f"profile: got {name!r}{hint} expected a number of this fit: {', '.join(fields)}, with _<nm> for one wavelength"
            )
    return tuple(names)


def make_priors(table: Mapping[str, Any], parameters: "Parameters") -> "list[Prior]":
    """The priors of one table of a scene file; of a kind, those on numbers that vary in the fit."""
    from fitting import priors

    said, kind = {key: value for key, value in table.items() if key != "kind"}, table["kind"]
    if kind == "number":
        relative = "relative_error" in said
        error = said["relative_error" if relative else "error"]
        return [priors.Prior(said["name"], said["value"], error, relative, "the scene file")]
    if kind == "molecular":
        stated = priors.molecular(parameters, **said)
    elif kind == "ozone":
        stated = priors.ozone(**(said | {"day_of_year": int(said["day_of_year"])}))
    else:
        stated = priors.aerosol(said["type"], parameters)
    _, numbers = priors.varying(parameters)
    known = {*(number.name for number in numbers), *(number.field for number in numbers)}
    found = [prior for prior in stated if prior.name in known]
    if not found:
        raise InputError(
            f"prior: kind = {kind!r} says nothing of what is free ({', '.join(parameters.fields)}); leave it out"
        )
    return found


def image_names(images: Sequence[ImageSpec]) -> list[str]:
    """A name for each image: that of its file, and a number where several files have the same."""
    stems = [printable(image.file.stem) for image in images]
    total, seen = Counter(stems), Counter[str]()
    names = []
    for stem in stems:
        seen[stem] += 1
        names.append(stem if total[stem] == 1 else f"{stem}_{seen[stem]}")
    return names
