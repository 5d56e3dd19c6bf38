"""``diffatmo fit``: recover the parameters of an atmosphere from images of its sky."""

import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from diffatmo.cli import keys, shipped
from diffatmo.cli.common import InputError, make_model, overwrite_option, read_atmosphere
from diffatmo.cli.images import observe
from diffatmo.cli.scenefile import FREE, IMAGE_KEYS, MODELS, FitSpec, ImageSpec, check_image_options, read_scene

if TYPE_CHECKING:
    from diffatmo.atmosphere import Atmosphere
    from diffatmo.models import Model
    from fitting import Observation, Step

NOT_CONVERGED = 1
MAX_STEPS = 100
PLAIN_WIDTH = 120
"""Columns of the output where it does not go to a terminal."""


@click.command()
@click.argument("images", metavar="[IMAGE]...", nargs=-1, type=click.Path(path_type=Path))
@click.option("--config", metavar="SCENE.toml", type=click.Path(path_type=Path), help="Scene file, instead of images.")
@click.option(
    "--init", metavar="ATM.toml", help="Where the fit starts: an atmosphere file or a preset.  [default: earth]"
)
@click.option("--free", metavar="NAME,...", help=f"Parameters to recover.  [default: {', '.join(FREE)}]")
@click.option(
    "--tie",
    metavar="NAME=TIE,...",
    help="How wavelengths hang together: start (keep the ratios of the start), grey, lambda^-4, dobson, mie=angstrom.",
)
@click.option("--model", type=click.Choice(MODELS), help="How the sky is computed.  [default: moments]")
@click.option("--max-steps", type=click.IntRange(min=1), help="Steps before the fit gives up.  [default: 100]")
@keys.options(IMAGE_KEYS)
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
    model: str | None,
    max_steps: int | None,
    output: Path,
    overwrite: bool,
    **values: Any,
) -> int:
    """Recover an atmosphere from images of its sky.

    An EXR image written by diffatmo knows its camera and sun; for others, the options say them, for all images alike. A
    scene file says them for each image. Without images or a scene file, the images that come with diffatmo are fitted.

    Writes fit.json, atmosphere.toml, pictures of images, fits and residuals, and report.html.
    """
    override = {"init": init, "free": _names(free), "tie": _ties(tie), "model": model, "max_steps": max_steps}
    specs = plan(images, config, keys.given(IMAGE_KEYS, values), output)
    # All that can be wrong is found before the first fit, which is written as soon as it is done.
    jobs = {directory: prepare(spec.override(**override)) for directory, spec in specs.items()}
    from fitting import report

    for directory in jobs:
        report.check_writable(directory, overwrite=overwrite)
    converged = [run(job, directory, overwrite=overwrite) for directory, job in jobs.items()]
    return 0 if all(converged) else NOT_CONVERGED


def plan(images: Sequence[Path], config: Path | None, options: Mapping[str, Any], output: Path) -> dict[Path, FitSpec]:
    """What to fit, by the directory its results go to."""
    if images and config:
        raise InputError("IMAGE and --config contradict each other: the scene file names the images")
    if options and not images:
        flag = keys.flag_of(next(iter(options)))
        raise InputError(f"{flag} describes an IMAGE, but none is given" + (f"; say it in {config}" if config else ""))
    if images:
        check_image_options(options)
        return {output: FitSpec(tuple(ImageSpec(image, options) for image in images))}
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
    model: str
    refine: bool
    max_steps: int


def prepare(spec: FitSpec) -> Job:
    """Read all that ``spec`` names."""
    from diffatmo.atmosphere import dumps
    from fitting.parameters import select

    init = read_atmosphere(spec.init or "earth")
    free, tie = spec.free if spec.free is not None else FREE, spec.tie or {}
    select(init, free, tie)
    seen = [observe(image, name, init) for image, name in zip(spec.images, image_names(spec.images), strict=True)]
    # Images of different atmospheres have no truth in common.
    truths = {dumps(truth): truth for truth in (image.truth for image in seen) if truth is not None}
    model = spec.model or MODELS[0]
    return Job(
        observations=[image.observation for image in seen],
        init=init,
        truth=next(iter(truths.values())) if len(truths) == 1 else None,
        free=tuple(free),
        tie=tie,
        model=model,
        # A finer model would correct what is not wrong in images that the model itself has made.
        refine=any(image.model != model for image in seen),
        max_steps=spec.max_steps or MAX_STEPS,
    )


def image_names(images: Sequence[ImageSpec]) -> list[str]:
    """A name for each image: that of its file, and a number where several files have the same."""
    stems = [image.file.stem for image in images]
    total, seen = Counter(stems), Counter[str]()
    names = []
    for stem in stems:
        seen[stem] += 1
        names.append(stem if total[stem] == 1 else f"{stem}_{seen[stem]}")
    return names


def fitting_model(name: str) -> "Model":
    """The model called ``name``, at the resolution that fits use."""
    from diffatmo.models import Bruneton

    return Bruneton.reduced() if name == "bruneton" else make_model(name)


def run(job: Job, directory: Path, *, overwrite: bool) -> bool:
    """Fit, write the report, show the table; whether the fit converged."""
    from rich.console import Console

    import fitting
    from fitting import report

    console = Console(width=None if sys.stdout.isatty() else PLAIN_WIDTH, highlight=False)
    count = len(job.observations)
    console.print(f"\n[bold]{directory.name}[/]: {count} image{'s' * (count > 1)}, free: {', '.join(job.free)}")

    for observation in job.observations:
        if observation.block > 1:
            size = f"{observation.block}×{observation.block}"
            console.print(f"  {observation.name}: {observation.used.sum()} averages of {size} pixels")

    def show(step: "Step") -> None:
        mark = "" if step.accepted else "  (rejected)"
        console.print(f"  step {step.step:3}  reduced χ² {step.reduced_chi2:<10.5g}  {step.seconds:.2f} s{mark}")

    with console.status("compiling the model and its derivatives, then fitting …"):
        result = fitting.fit(
            job.observations,
            init=job.init,
            free=job.free,
            tie=job.tie,
            model=fitting_model(job.model),
            progress=show,
            max_steps=job.max_steps,
            refine=job.refine,
        )
        report.write(result, directory, truth=job.truth, overwrite=overwrite)
    console.print(report.table(result, job.truth))
    console.print(f"Report: {directory / 'report.html'}", soft_wrap=True)
    return result.converged


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
