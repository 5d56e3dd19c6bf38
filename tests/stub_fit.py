"""A stand-in for a fit that takes no time, and can be told where to be killed: for tests of what goes on around fits.

An image is a text file with a number. A file ``<image>.fault`` beside it, which is gone afterwards, says ``who when``: whether
the process that fits or its parent is killed, and at what point.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

from diffatmo import folders, imageio
from diffatmo.cli import many, results
from diffatmo.cli.common import InputError
from diffatmo.cli.scenefile import FitSpec, ImageSpec


def prepare(spec):
    if not spec.images:
        return None
    file = spec.images[0].file
    strike(file, "read")
    text = file.read_text()
    if text == "a fault":
        raise KeyError(text)
    try:
        return file, float(text)
    except ValueError as error:
        raise InputError(f"{file}: not a number") from error


def run(job, directory, overwrite):
    file, value = job
    strike(file, "fit")
    folders.prepare(directory, names=(results.RECORD, "page"), overwrite=overwrite)
    (directory / ".page.0123.part").write_text("half a pa")
    strike(file, "write")
    (directory / ".page.0123.part").unlink()
    for name, text in {results.RECORD: record(file.stem, value), "page": "a page"}.items():
        with imageio.atomic_write(directory / name, overwrite=overwrite) as temporary:
            temporary.write_text(text)
        strike(file, "between")


def record(name, value, **exposures):
    """What a fit of one image writes, as far as the table reads it."""

    def entry(value, error):
        return {"unit": "", "value": value, "standard_error": error}

    return json.dumps(
        {
            "converged": value < 100,
            "message": "done" if value < 100 else "stopped",
            "reduced_chi2": 1.0,
            "wavelengths_nm": [680.0, 550.5],
            "parameters": {"mie_g": entry(value, 0.1), "ozone_absorption": entry([1.0, value], [0.5, None])},
            "derived": {},
            "nuisances": {key: entry(item, 0.2) for key, item in exposures.items()},
            "doubts": ["It is a stub.", "So it is."],
            "images": [{"name": name, "residuals": {"median_absolute_relative": [0.02, 0.03, 0.01]}}],
            "timings": {"total_s": 0.1234567},
        }
    )


def strike(file, now):
    fault = Path(f"{file}.fault")
    if not fault.exists():
        return
    who, when = fault.read_text().split()
    if when == now:
        fault.unlink()
        if who == "sleep":
            time.sleep(60)
        os.kill({"self": os.getpid(), "parent": os.getppid()}[who], signal.SIGKILL)
        if who == "parent":
            # Whoever is left must not go on.
            time.sleep(60)


def spec(*files, **values):
    return FitSpec(tuple(ImageSpec(Path(file)) for file in files), **values)


def main():
    # Programs begun in the background of a shell have interrupts ignored, and their children with them.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    output, jobs, *files = sys.argv[1:]
    whole = results.dumps

    def dumps(rows):
        # The parent itself may be told to die as it writes its table.
        rows = list(rows)
        for row in rows:
            strike(row["file"], "table")
        return whole(rows)

    results.dumps = dumps
    sys.exit(many.fit_each(spec(*files), Path(output), many.Fitter(prepare, run), jobs=int(jobs), resume=True))
