"""``diffatmo fit``: recover the parameters of an atmosphere from images of its sky."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from diffatmo.cli import keys, many, shipped
from diffatmo.cli.common import INTERRUPTED, InputError, make_console, overwrite_option
from diffatmo.cli.jobs import prepare
from diffatmo.cli.running import run, run_quietly
from diffatmo.cli.scenefile import FREE, IMAGE_KEYS, LOSSES, MODELS, FitSpec, bracket, check_image_options, read_scene

HEADINGS = {
    "config": "What is fitted, and how",
    "projection": "Camera",
    "altitude_km": "Place and sun",
    "exposure": "What may be off",
    "noise": "Noise, and pixels to leave out",
    "transfer": "Photos and brackets",
    "bracketed": "The run",
}
"""Of the help, by the first option under each."""


@click.command(cls=keys.Headed, headings=HEADINGS)
@click.argument("images", metavar="[IMAGE|FOLDER]...", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--config",
    metavar="SCENE.toml",
    type=click.Path(path_type=Path),
    help="Scene file, instead of images; SCENE.toml alone does the same.",
)
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
        if resume and first and not begun[directory]:
            make_console().print(
                f"{directory}: no fit was broken off here; this one begins at its start", soft_wrap=True
            )
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
    if len(images) == 1 and images[0].suffix.lower() == ".toml" and not config:
        return plan((), images[0], options, output)
    if images and config:
        raise InputError("IMAGE and --config contradict each other: the scene file names the images")
    if options and not images:
        flag = keys.flag_of(next(iter(options)))
        raise InputError(f"{flag} describes an IMAGE, but none is given" + (f"; say it in {config}" if config else ""))
    if images:
        for image in images:
            if image.suffix.lower() == ".toml":
                raise InputError(f"{image}: not an image; a scene file goes alone, an atmosphere with --init")
        check_image_options(options, complete=False)
        views = [images] if bracketed else [[image] for image in images]
        return {output: FitSpec(tuple(bracket(files, options) for files in views))}
    if config:
        return {output: read_scene(config)}
    return {output / scene.parent.name: read_scene(scene) for scene in shipped.scenes()}


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
