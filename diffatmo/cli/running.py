"""Run a fit that is ready, tell how it goes, and write and show what came out."""

from pathlib import Path
from typing import TYPE_CHECKING

from diffatmo.cli.common import INTERRUPTED, make_console, make_model, printable, waiting
from diffatmo.cli.jobs import Job

if TYPE_CHECKING:
    from diffatmo.models import Model
    from fitting import Step
    from fitting.report import Plate

NOT_CONVERGED = 1
"""Exit status of a fit that ran but found no optimum."""


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
        if step.aim and (not history or step.stage != history[-1].stage):
            console.print(f"  {step.aim}:")
        history.append(step)
        mark = "" if step.accepted else "  (rejected)"
        left = steps_left(history, TOLERANCE)
        # None are left in this search: there may be another.
        told = left and left <= job.max_steps - len(history)
        time = f"  about {(left or 0) * step.seconds:.0f} s left" if told else ""
        console.print(f"  step {step.step:3}  reduced χ² {step.reduced_chi2:<10.5g}  {step.seconds:.2f} s{time}{mark}")

    def show_point(name: str, value: float, growth: float) -> None:
        console.print(f"  {name} = {value:<10.5g}  Δχ² {growth:.3g}")

    with waiting(console, "compiling the model and its derivatives, then fitting …"):
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
        interrupted = result.message == search.INTERRUPTED
        if job.profile and result.converged:
            console.print("Profiles:")
            result = fitting.profile(result, *job.profile, progress=show_point)
        elif job.profile and not interrupted:
            console.print("No profiles: they are about an optimum, and none was found.")
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
