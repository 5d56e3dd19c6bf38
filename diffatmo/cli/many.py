"""Many images, each fitted on its own: in parallel, resumable, and with one table of what was found.

Each image is fitted in a process of its own that is used again for the next (:mod:`diffatmo.cli.workers`), and has a folder
for what it leaves; :mod:`diffatmo.cli.origin` says whether that is complete. The table (:mod:`diffatmo.cli.results`) is
written anew after every image, so that whatever happens it holds all that is done.
"""

import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from diffatmo import folders
from diffatmo.cli import origin, results, workers
from diffatmo.cli.common import INTERRUPTED, InputError, is_refusal, make_console, one_line, printable
from diffatmo.cli.scenefile import FitSpec

if TYPE_CHECKING:
    from rich.console import Console

SUFFIXES = (
    *(".exr", ".hdr", ".pic", ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".heic", ".heif", ".hif"),
    *(".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw"),
)
"""What the images in a folder end in; a file named by itself may end in anything."""

MOST_JOBS = 8
"""Unless asked for more: each takes a gigabyte or two of memory."""

INCOMPLETE = 1
"""Exit status if not every image was fitted, or the table could not be written."""

SHOWN = 3
"""Names in a list on the terminal."""


class Task(NamedTuple):
    """One image to be fitted, and the folder for what is found."""

    spec: FitSpec
    directory: Path

    @property
    def file(self) -> Path:
        """The image."""
        return self.spec.images[0].file

    def tidy(self) -> None:
        """Remove what a fit that was cut off has left: files that are not whole, and a folder that is empty."""
        folders.sweep(self.directory)
        with suppress(OSError):
            self.directory.rmdir()


class Fitter(NamedTuple):
    """How one image is fitted, in two functions that other processes can import."""

    prepare: Callable[[FitSpec], Any]
    """Reads and checks all that a fit needs; of a fit without images, all that they have in common."""
    run: Callable[[Any, Path, bool], Any]
    """Fits what was prepared and writes the results into the folder, which it makes; over others if the last is true."""


def expand(images: Sequence[Path], *, mask: Path | None = None) -> list[Path]:
    """``images`` with the images in it for each folder, without the ``mask``, which may lie beside them."""
    files: list[Path] = []
    for path in images:
        if not path.is_dir():
            files.append(path)
            continue
        inside = sorted(
            file
            for file in path.iterdir()
            if file.suffix.lower() in SUFFIXES and not file.name.startswith(".") and not file.is_dir()
        )
        inside = [file for file in inside if mask is None or file.resolve() != mask.resolve()]
        if not inside:
            raise InputError(f"{path}: no image in this folder, expected files that end in {', '.join(SUFFIXES)}")
        files += inside
    return files


def folder_names(files: Sequence[Path]) -> list[str]:
    """A folder for each file: called like it, without its ending where that is clear, and numbered where it must be."""
    stems = Counter(printable(file.stem).casefold() for file in files)
    taken = {results.FILE}
    names = []
    for file in files:
        stem = printable(file.stem)
        name = stem if stems[stem.casefold()] == 1 and stem.strip(".") else printable(file.name)
        unique, number = name, 2
        while unique.casefold() in taken:
            unique, number = f"{name}_{number}", number + 1
        taken.add(unique.casefold())
        names.append(unique)
    return names


def default_jobs() -> int:
    """One for every two cores that may be used: the compiler and the model use more than one."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(MOST_JOBS, cores // 2))


def fit_each(
    spec: FitSpec,
    output: Path,
    fitter: Fitter,
    *,
    jobs: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> int:
    """Fit every image of ``spec`` on its own, show how it goes, and return the exit status.

    ``output`` gets a folder for each image and the table. With ``resume`` results that are complete, and made from the same
    image, options and version, stay; others are replaced, as with ``overwrite`` all are.
    """
    fitter.prepare(replace(spec, images=()))
    names = folder_names([image.file for image in spec.images])
    tasks = [
        Task(replace(spec, images=(image,)), output / name) for image, name in zip(spec.images, names, strict=True)
    ]
    if not resume and not overwrite:
        _check_free(output, tasks)
    folders.prepare(output, names=(), overwrite=True)
    with folders.claim(output):
        folders.sweep(output)
        run = _Run(_Table(output / results.FILE, {task.directory: None for task in tasks}), make_console())
        if resume:
            tasks = run.take_over(tasks)
        status = run.fit(tasks, partial(_work, fitter, resume or overwrite), jobs or default_jobs())
    return status


def _check_free(output: Path, tasks: Sequence[Task]) -> None:
    """Refuse to replace results."""
    if (output / results.FILE).exists():
        raise InputError(
            f"{output}: holds results already ({results.FILE}); choose another folder, --resume to go on, or --overwrite"
        )
    for directory in (output, *(task.directory for task in tasks)):
        folders.check_free(directory, names=(results.RECORD, origin.FILE))


@dataclass
class _Table:
    """The table on disk: written anew as a whole each time, so that a reader never sees half of it."""

    path: Path
    rows: dict[Path, results.Row | None]
    """By the image's folder, in the order of the images; None while there is none."""
    trouble: str = ""
    """Why it could not be written the last time."""

    def write(self) -> None:
        """Write what is known; if that cannot be done, the run goes on, as the results are in their folders."""
        from diffatmo import imageio

        self.trouble = ""
        try:
            with imageio.atomic_write(self.path, overwrite=True) as temporary:
                temporary.write_text(results.dumps(row for row in self.rows.values() if row), encoding="utf-8")
        except imageio.ImageError as error:
            self.trouble = one_line(error)


class _Run(NamedTuple):
    """A run: what it has found, and where it tells how it goes."""

    table: _Table
    console: "Console"

    def say(self, text: str) -> None:
        """A line on the terminal."""
        self.console.print(printable(text), soft_wrap=True)

    def take_over(self, tasks: Sequence[Task]) -> list[Task]:
        """Enter what is complete into the table; the tasks that are left, having said why some are done again."""
        todo: list[Task] = []
        again: dict[str, list[str]] = {}
        rows = self.table.rows
        for task in tasks:
            row = results.row(task.file, task.directory)
            reason = origin.difference(task.directory, task.spec)
            if row and not reason:
                rows[task.directory] = row
                continue
            todo.append(task)
            if row or not reason:
                again.setdefault(reason or f"{results.RECORD} is damaged", []).append(task.directory.name)
        for directory, file in origin.made_in(self.table.path.parent).items():
            if directory not in rows:
                # Of an image that is not there any more, or was not asked for this time: not to be lost.
                rows[directory] = results.row(file, directory)
        self.say(f"{len(tasks) - len(todo)} of {_count(tasks)} fitted already")
        for reason, names in again.items():
            more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
            self.say(f"fitted again: {', '.join(names[:SHOWN])}{more}: {reason}")
        return todo

    def fit(self, tasks: Sequence[Task], work: Callable[[Task], str | None], jobs: int) -> int:
        """Do the tasks, with a row in the table and a line on the terminal for each; the exit status."""
        started, done, interrupted = time.monotonic(), 0, False
        if tasks:
            self.say(f"{_count(tasks)} to fit, {min(jobs, len(tasks))} at a time")
        try:
            with closing(workers.each(work, tasks, jobs=jobs)) as outcomes:
                for index, outcome in outcomes:
                    done += 1
                    self.say(f"[{done:{len(str(len(tasks)))}}/{len(tasks)}] {self.enter(tasks[index], outcome)}")
        except KeyboardInterrupt:
            interrupted = True
            for task in tasks:
                if self.table.rows[task.directory] is None:
                    task.tidy()
        self.table.write()
        states = Counter(row["status"] for row in self.table.rows.values() if row)
        counts = ", ".join(f"{states[state]} {state}" for state in results.STATES)
        self.say(f"{counts}; {time.monotonic() - started:.0f} s. Table: {self.table.path}")
        if self.table.trouble:
            print("diffatmo: error:", printable(self.table.trouble), file=sys.stderr)
        if interrupted:
            self.say(f"Interrupted, {_count(tasks[done:])} left; the same command with --resume goes on")
            return INTERRUPTED
        return INCOMPLETE if self.table.trouble or states[results.CONVERGED] < states.total() else 0

    def enter(self, task: Task, outcome: str | workers.Died | None) -> str:
        """Put what became of ``task`` into the table; the same in a few words."""
        row = results.row(task.file, task.directory) if outcome is None else None
        if row is None:
            row = results.failure(task.file, _why(task, outcome))
            task.tidy()
        self.table.rows[task.directory] = row
        written = not self.table.trouble
        self.table.write()
        news = f"; {self.table.trouble}" if written and self.table.trouble else ""
        return f"{task.directory.name}: {_told(row)}{news}"


def _why(task: Task, outcome: str | workers.Died | None) -> str:
    """Why there is no result."""
    if isinstance(outcome, workers.Died):
        return f"{task.file}: {outcome}"
    return outcome or f"{task.directory / results.RECORD}: cannot be read back"


def _told(row: results.Row) -> str:
    """A row in a few words."""
    if row["status"] == results.FAILED:
        return f"failed: {row['message']}"
    message = "" if row["status"] == results.CONVERGED else f" ({row['message']})"
    doubtful = ", doubtful" * bool(row["doubts"])
    residual = f"residual {row['residual_percent']:.2g} %"
    return (
        f"{row['status']}{message}{doubtful}, reduced χ² {row['reduced_chi2']:.4g}, {residual}, {row['seconds']:.1f} s"
    )


def _count(tasks: Sequence[Task]) -> str:
    return f"{len(tasks)} image{'s' * (len(tasks) != 1)}"


def _work(fitter: Fitter, overwrite: bool, task: Task) -> str | None:
    """Fit one image, in a process of its own; what is wrong if it cannot be fitted."""
    # The first of several processes would else take the memory of an accelerator for itself.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    from diffatmo import imageio

    try:
        # Before the image is read: if it changes while it is fitted, that will be seen.
        made_from = origin.dumps(task.spec)
        job = fitter.prepare(task.spec)
        folders.sweep(task.directory)
        (task.directory / origin.FILE).unlink(missing_ok=True)
        fitter.run(job, task.directory, overwrite)
        with imageio.atomic_write(task.directory / origin.FILE) as temporary:
            temporary.write_text(made_from, encoding="utf-8")
    except MemoryError:
        return f"{task.file}: not enough memory; fit fewer at a time (--jobs)"
    except (OSError, ValueError) as error:
        if not is_refusal(error):
            raise
        return one_line(error)
    return None
