"""``diffatmo fit``: recover the parameters of an atmosphere from images of its sky."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from diffatmo.cli import keys, many, photo, scans, shipped
from diffatmo.cli.common import (
    INTERRUPTED,
    InputError,
    make_console,
    make_model,
    overwrite_option,
    printable,
    read_atmosphere,
)
from diffatmo.cli.images import View, observe, observe_photo, open_image, stated
from diffatmo.cli.scenefile import (
    FREE,
    IMAGE_KEYS,
    LOSSES,
    MODELS,
    FitSpec,
    ImageSpec,
    bracket,
    check_image_options,
    did_you_mean,
    read_scene,
)

if TYPE_CHECKING:
    from diffatmo.atmosphere import Atmosphere
    from diffatmo.models import Model
    from fitting import Observation, Prior, Step
    from fitting.parameters import Parameters
    from fitting.report import Plate

NOT_CONVERGED = 1
MAX_STEPS = 100


@click.command()
@click.argument("images", metavar="[IMAGE|FOLDER]...", nargs=-1, type=click.Path(path_type=Path))
@click.option("--config", metavar="SCENE.toml", type=click.Path(path_type=Path), help="Scene file, instead of images.")
@click.option(
    "--init",
    metavar="ATM.toml",
    help="Where the fit starts: an atmosphere file or a preset.  [default: earth; of photos and scans a start of their own]",
)
@click.option(
    "--free",
    metavar="NAME,...",
    help=f"Parameters to recover.  [default: {', '.join(FREE)}; of photos and scans fewer]",
)
@click.option(
    "--tie",
    metavar="NAME=TIE,...",
    help="How wavelengths hang together: start (keep the ratios of the start), grey, lambda^-4, dobson, mie=angstrom.",
)
@click.option(
    "--loss", type=click.Choice(LOSSES), help="For clouds and objects in the picture, instead of least squares."
)
@click.option("--model", type=click.Choice(MODELS), help="How the sky is computed.  [default: moments]")
@click.option("--max-steps", type=click.IntRange(min=1), help="Steps before the fit gives up.  [default: 100]")
@click.option(
    "--starts",
    type=click.IntRange(min=1),
    help="From how many starts to search: the given one and the best of a grid about it.  [default: 1, and 3 more if that goes "
    "astray]",
)
@click.option(
    "--profile", metavar="NAME,...", help="Numbers whose profile likelihood is wanted: mie_g, mie_optical_depth_550, …"
)
@keys.options(IMAGE_KEYS)
@click.option(
    "--bracket",
    "bracketed",
    is_flag=True,
    help="The IMAGEs are exposures of one view, to be merged into one picture before it is fitted.",
)
@click.option("--each", is_flag=True, help="Fit each image on its own, as those of a FOLDER are.")
@click.option(
    "--jobs",
    "processes",
    type=click.IntRange(min=1),
    help="Images of a FOLDER fitted at a time; each takes 1 to 2 GB of memory.  [default: one for every two cores, up to 8]",
)
@click.option(
    "--hosts",
    nargs=3,
    type=(str, click.IntRange(min=2), click.IntRange(min=0)),
    metavar="ADDRESS:PORT COUNT NUMBER",
    help="Share out the pixels of a joint fit: this is process NUMBER of COUNT, of which 0 is at ADDRESS and writes DIR.",
)
@click.option(
    "--resume",
    is_flag=True,
    help="Go on with a fit that was broken off; of a FOLDER, fit only what has no complete result.",
)
@click.option(
    "-o",
    "--output",
    metavar="DIR",
    type=click.Path(path_type=Path),
    default=Path("results"),
    show_default=True,
    help="Directory to write.",
)
@overwrite_option
def fit(
    images: tuple[Path, ...],
    config: Path | None,
    init: str | None,
    free: str | None,
    tie: str | None,
    loss: str | None,
    model: str | None,
    max_steps: int | None,
    starts: int | None,
    profile: str | None,
    bracketed: bool,
    each: bool,
    processes: int | None,
    hosts: tuple[str, int, int] | None,
    resume: bool,
    output: Path,
    overwrite: bool,
    **values: Any,
) -> int:
    """Recover an atmosphere from images of its sky.

    An EXR image written by diffatmo knows its camera and sun; for others, the options say them, for all images alike. A
    scene file says them for each image. Several images are fitted jointly, with --bracket merged into one, with --each on
    their own. Without images or a scene file, the images that come with diffatmo are fitted.

    A photo (three channels, without --init) needs the options alone that its file does not answer, and is asked for them:
    JPEG, HEIF, RAW, TIFF, HDR panoramas. It has defaults of its own, which are printed: other parameters, a start and
    priors of a clear day, noise of 5 %, 15° around the sun and the lowest 5 or 10° left out, exposure and pose fitted. So
    has a scan, a .npz or .csv of measured spectra.

    Writes fit.json, atmosphere.toml, pictures of images, fits and residuals, of a photo mask.png, which shows what of it
    was fitted, and report.html.

    A FOLDER stands for the images in it, each fitted on its own, several at a time: DIR gets a folder for each image, and
    results.csv with a row for each. One that cannot be fitted does not stop the others.
    """
    override = {
        "init": init,
        "free": _names(free),
        "tie": _ties(tie),
        "loss": loss,
        "model": model,
        "max_steps": max_steps,
        "starts": starts,
        "profile": _names(profile),
    }
    if resume and overwrite:
        raise InputError("--resume and --overwrite contradict each other: one keeps what is there, one replaces it")
    options = keys.given(IMAGE_KEYS, values)
    if bracketed:
        check_bracket(images, each=each)
    if each or any(image.is_dir() for image in images):
        if not images and not config:
            raise InputError("--each: no IMAGE, FOLDER or --config says what to fit")
        if hosts:
            raise InputError("--hosts is for a joint fit; of a FOLDER, give each host images of its own")
        mask = Path(options["mask"]) if "mask" in options else None
        (spec,) = plan(many.expand(images, mask=mask), config, options, output).values()
        spec, fitter = spec.override(**override), many.Fitter(prepare, run_quietly)
        return many.fit_each(spec, output, fitter, jobs=processes, resume=resume, overwrite=overwrite)
    if processes:
        raise InputError("--jobs is for the images of a FOLDER, or with --each")
    first = join(hosts)
    specs = plan(images, config, options, output, bracketed=bracketed)
    # All that can be wrong is found before the first fit, which is written as soon as it is done.
    for directory, spec in specs.items():
        check_masks(spec, directory)
    jobs = {directory: prepare(spec.override(**override)) for directory, spec in specs.items()}
    from fitting import checkpoint, report

    begun = {directory: check_begun(directory, resume=resume, overwrite=overwrite) for directory in jobs}
    if first:
        for directory in jobs:
            report.check_writable(directory, overwrite=overwrite or begun[directory])
            if overwrite:
                (directory / checkpoint.FILE).unlink(missing_ok=True)
    statuses: list[int] = []
    for directory, job in jobs.items():
        statuses.append(run(job, directory, overwrite=overwrite or begun[directory], quiet=not first, write=first))
        if statuses[-1] == INTERRUPTED:
            break
    return max(statuses)


def join(hosts: tuple[str, int, int] | None) -> bool:
    """Meet the other processes, if there are any; whether this is the one that speaks and writes."""
    if hosts is None:
        return True
    import jax

    address, count, number = hosts
    if number >= count:
        raise InputError(f"--hosts: got number {number} of {count} processes, expected 0 to {count - 1}")
    try:
        jax.distributed.initialize(address, count, number)
    except RuntimeError as error:
        raise InputError(f"--hosts: {address}: the processes have not met: {error}") from error
    return number == 0


def check_begun(directory: Path, *, resume: bool, overwrite: bool) -> bool:
    """Whether an unfinished fit goes on in ``directory``; refuses one that is neither to go on nor to be replaced."""
    from fitting import checkpoint

    file = directory / checkpoint.FILE
    if not (resume or overwrite) and file.exists():
        raise InputError(
            f"{file}: a fit was broken off here; give --resume to go on with it, or --overwrite to begin anew"
        )
    if resume and not file.exists() and (directory / "fit.json").exists():
        raise InputError(
            f"{directory}: the fit here is complete, there is nothing to go on with; --overwrite fits again, -o elsewhere"
        )
    return resume and file.exists()


def check_masks(spec: FitSpec, directory: Path) -> None:
    """Refuse a mask that the picture of the mask in the report would replace."""
    for image in spec.images:
        mask = Path(image.options.get("mask", ""))
        if mask.parent.resolve() == directory.resolve() and (mask.name == "mask.png" or mask.name.startswith("mask_")):
            raise InputError(
                f"mask: {mask} bears the name of a file of the report, expected one outside of {directory}"
            )


def check_bracket(images: Sequence[Path], *, each: bool) -> None:
    """Refuse what cannot be the exposures of one view."""
    if each:
        raise InputError("--bracket and --each contradict each other: one makes one picture of the IMAGEs")
    if len(images) < 2:
        raise InputError(
            f"--bracket: got {len(images)} IMAGE, expected at least two exposures of one view; a scene file has a list as file"
        )
    for image in images:
        if image.is_dir():
            raise InputError(f"--bracket: {image} is a folder, expected the files of one view by name")


def plan(
    images: Sequence[Path],
    config: Path | None,
    options: Mapping[str, Any],
    output: Path,
    *,
    bracketed: bool = False,
) -> dict[Path, FitSpec]:
    """What to fit, by the directory its results go to."""
    if images and config:
        raise InputError("IMAGE and --config contradict each other: the scene file names the images")
    if options and not images:
        flag = keys.flag_of(next(iter(options)))
        raise InputError(f"{flag} describes an IMAGE, but none is given" + (f"; say it in {config}" if config else ""))
    if images:
        for image in images:
            if image.suffix.lower() == ".toml":
                raise InputError(f"{image}: not an image; a scene file goes with --config, an atmosphere with --init")
        check_image_options(options, complete=False)
        views = [images] if bracketed else [[image] for image in images]
        return {output: FitSpec(tuple(bracket(files, options) for files in views))}
    if config:
        return {output: read_scene(config)}
    return {output / scene.parent.name: read_scene(scene) for scene in shipped.scenes()}


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
            raise InputError(
                f"profile: got {name!r}{did_you_mean(name, tuple(known))}; expected a number of this fit: {', '.join(fields)}, "
                "with _<nm> for one wavelength"
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
        stated = priors.molecular(parameters.init, **said)
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


def fitting_model(name: str, *, photos: bool = False) -> "Model":
    """The model called ``name``, at the resolution that fits use."""
    from diffatmo.models import Bruneton, Moments

    if name == "bruneton":
        return Bruneton.reduced()
    return Moments.coarse() if photos and name == "moments" else make_model(name)


def run(job: Job, directory: Path, *, overwrite: bool, quiet: bool = False, write: bool = True) -> int:
    """Fit, write the report, show the table unless ``quiet``; the exit status."""
    from rich.text import Text

    import fitting
    from fitting import checkpoint, report, search
    from fitting.search import steps_left
    from fitting.solve import TOLERANCE

    console = make_console(quiet=quiet)
    file = directory / checkpoint.FILE
    if file.exists():
        console.print(f"Going on from {printable(file)}")
    count = len(job.observations)
    name = Text(f"\n{printable(directory.name)}", style="bold")
    console.print(name + f": {count} image{'s' * (count > 1)}, free: {', '.join(job.free)}")

    for line in job.assumed:
        console.print(f"  {line}", soft_wrap=True)
    for observation in job.observations:
        if observation.masked:
            left_out = ", ".join(f"{count} {reason}" for reason, count in observation.masked.items())
            console.print(f"  {observation.name}: pixels left out: {left_out}", soft_wrap=True)
        if observation.block > 1:
            size = f"{observation.block}×{observation.block}"
            console.print(f"  {observation.name}: {observation.used.sum()} averages of {size} pixels")

    history: list[Step] = []

    def show(step: "Step") -> None:
        history.append(step)
        mark = "" if step.accepted else "  (rejected)"
        left = steps_left(history, TOLERANCE)
        told = left is not None and left <= job.max_steps - len(history)
        time = f"  about {(left or 0) * step.seconds:.0f} s left" if told else ""
        console.print(f"  step {step.step:3}  reduced χ² {step.reduced_chi2:<10.5g}  {step.seconds:.2f} s{time}{mark}")

    def show_point(name: str, value: float, growth: float) -> None:
        console.print(f"  {name} = {value:<10.5g}  Δχ² {growth:.3g}")

    with console.status("compiling the model and its derivatives, then fitting …"):
        result = fitting.fit(
            job.observations,
            init=job.init,
            free=job.free,
            tie=job.tie,
            priors=job.priors,
            loss=job.loss,
            model=fitting_model(job.model, photos=job.photos),
            progress=show,
            max_steps=job.max_steps,
            refine=job.refine,
            starts=job.starts,
            checkpoint=file,
        )
        if job.profile and result.converged:
            console.print("Profiles:")
            result = fitting.profile(result, *job.profile, progress=show_point)
        elif job.profile:
            console.print("No profiles: they are about an optimum, and none was found.")
        interrupted = result.message == search.INTERRUPTED
        status = INTERRUPTED if interrupted else 0 if result.converged else NOT_CONVERGED
        if not write:
            return status
        report.write(result, directory, truth=job.truth, plates=plates(job), overwrite=overwrite)
    if not interrupted:
        file.unlink(missing_ok=True)
    console.print(report.overview(result))
    console.print(report.table(result, job.truth))
    for doubt in report.doubts(result):
        console.print(f"Doubtful: {doubt}", soft_wrap=True)
    if not result.converged:
        console.print(f"{result.message}{'; the same command with --resume goes on' * interrupted}", soft_wrap=True)
    console.print(f"Report: {directory / 'report.html'}", soft_wrap=True)
    return status


def plates(job: Job) -> "list[Plate]":
    """Each photo beside what of it is fitted: ``mask.png``, or of several ``mask_<image>.png``."""
    from fitting.figures import mask_figure, shares
    from fitting.report import Plate, file_names

    found: list[Plate] = []
    for name, view in zip(file_names(job.observations), job.views, strict=False):
        file = "mask.png" if len(job.views) == 1 else f"mask_{name}.png"
        fitted, *others = (f"{share} {what}" for what, share in shares(view.left_out).items())
        parts = fitted + f"; left out {', '.join(others)}" * bool(others)
        by = (
            "What is sky is what --mask says."
            if view.own_mask
            else "If sky was taken for something else, or something else for sky, give --mask: a picture of the size of the "
            "photo, black where pixels are to be left out."
        )
        found.append(Plate(file, mask_figure(view.pixels, view.left_out), f"{name}: of the picture {parts}. {by}"))
    return found


def run_quietly(job: Job, directory: Path, overwrite: bool) -> None:
    """One fit of many: found to be possible to write before it begins, and without a word. It does not go on from another."""
    from fitting import checkpoint, report

    (directory / checkpoint.FILE).unlink(missing_ok=True)
    report.check_writable(directory, overwrite=overwrite)
    run(job, directory, overwrite=overwrite, quiet=True)


def _names(text: str | None) -> tuple[str, ...] | None:
    return None if text is None else tuple(name.strip() for name in text.split(",") if name.strip())


def _ties(text: str | None) -> dict[str, str] | None:
    """``NAME=TIE,NAME=TIE`` as a mapping."""
    if text is None:
        return None
    pairs = [item.partition("=") for item in _names(text) or ()]
    for name, sign, kind in pairs:
        if not sign or not name or not kind:
            raise InputError(f"--tie: got {text!r}, expected NAME=TIE,... like mie=angstrom,ground_albedo=grey")
    return {name.strip(): kind.strip() for name, _, kind in pairs}
