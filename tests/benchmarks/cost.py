"""What a fit costs, in seconds and in memory, against pixels, parameters and images.

python tests/benchmarks/cost.py [--plot cost.png] [--largest 1e7] [--only pixels|averaged|numbers|images]

Every case is a process of its own, and a fit that is broken off after three steps: what a step costs does not change any more.
No pixels are averaged but in the series of that name, where the default decides how many. Memory is the largest the process
ever held: before the fit, with the images read, checked and in memory, and after. What the compiler needs is the same however
many pixels there are. The pictures are made by the default model, in processes of their own, and kept in a folder of the
system's temporary files.
"""

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from rich.console import Console
from rich.table import Table
from speed import processor

import diffatmo
import fitting
from diffatmo import sun
from diffatmo.camera import Equirectangular
from diffatmo.compiling import outermost
from diffatmo.models import Moments
from diffatmo.render import Scene, render

NOISE, ALTITUDE_KM, STEPS = 0.01, 0.1, 3
ORDER = (
    *("mie_g", "mie_scale_height", "rayleigh_scale_height", "rayleigh_scattering", "mie_scattering", "ground_albedo"),
    *("mie_absorption", "ozone_absorption", "ozone_center_altitude", "ozone_half_width"),
)
FREE = {3: ORDER[:3], 6: ORDER[:4], 9: ORDER[:5], 12: ORDER[:6], 20: ORDER}
"""Free fields by the number of their numbers at three wavelengths."""
PIXELS = (1e3, 1e4, 1e5, 1e6, 1e7)
IMAGES = (1, 4, 16, 64)
USUAL = {"pixels": 10_000, "numbers": 9, "images": 1, "averaged": 0}
SERIES = ("pixels", "averaged", "numbers", "images")
SMALL = 2_000
"""Pixels of each of many images."""


def camera(pixels: int) -> Equirectangular:
    """The upper half of the sky, four times as wide as high."""
    height = round(math.sqrt(pixels / 4))
    return Equirectangular(height=height, width=4 * height, upper=True)


def zeniths(images: int) -> np.ndarray:
    """Of the suns."""
    return np.linspace(0.6, 1.4, images) if images > 1 else np.array([1.0])


def picture(pixels: int, zenith: float) -> Path:
    """Where the picture is, with its noise; made if it is not there."""
    file = Path(tempfile.gettempdir()) / "diffatmo-cost" / f"{pixels}_{zenith:.4f}.npy"
    if not file.exists():
        file.parent.mkdir(exist_ok=True)
        scene = Scene(diffatmo.earth(), camera(pixels), ALTITUDE_KM, sun.direction(zenith=zenith, azimuth=0.5))
        light = np.asarray(outermost(render)(scene, Moments()))
        light = light * (1 + NOISE * np.random.default_rng(pixels).standard_normal(light.shape, np.float32))
        with file.with_suffix(".part").open("wb") as part:
            np.save(part, light.astype(np.float32))
        file.with_suffix(".part").rename(file)
    return file


def largest() -> int:
    """Bytes this process has held at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def measure(pixels: int, numbers: int, images: int, averaged: int) -> dict[str, float]:
    """Fit, in a process that does nothing else."""
    limit = {} if averaged else {"max_pixels": 2 * pixels}
    observations = [
        fitting.observe(
            np.load(picture(pixels, zenith)),
            camera=camera(pixels),
            altitude=ALTITUDE_KM,
            sun=sun.direction(zenith=zenith, azimuth=0.5),
            noise=NOISE,
            name=str(number),
            **limit,
        )
        for number, zenith in enumerate(zeniths(images))
    ]
    before = largest()
    air = diffatmo.earth()
    started = time.perf_counter()
    result = fitting.fit(
        observations, init=air, free=FREE[numbers], refine=False, max_steps=STEPS, tolerance=1e-6, starts=1
    )
    # The first of the steps stands on what was computed before it.
    return {
        "pixels": sum(int(observation.used.sum()) for observation in observations),
        "input": sum(12 * camera(pixels).height * camera(pixels).width for _ in observations),
        "before": before,
        "after": largest(),
        "step": float(np.median([step.seconds for step in result.history[1:]])),
        "compile": result.timings["compile_s"],
        "total": time.perf_counter() - started,
    }


def alone(*arguments: str) -> str:
    """This script in a process of its own: what it prints last."""
    command = [sys.executable, __file__, *arguments]
    # Programs that were kept from another run would hide what compiling them costs.
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": ""}
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment).stdout.splitlines()[
        -1
    ]


def series(largest_picture: float) -> dict[str, list[tuple[int, dict[str, int]]]]:
    """The cases, by what changes."""
    pixels = [int(n) for n in PIXELS if n <= largest_picture]
    of: dict[str, list[tuple[int, dict[str, int]]]] = {
        "pixels": [(n, {"pixels": n}) for n in pixels],
        "averaged": [(n, {"pixels": n, "averaged": 1}) for n in pixels],
        "numbers": [(n, {"numbers": n}) for n in FREE],
        "images": [(n, {"pixels": SMALL, "images": n}) for n in IMAGES],
    }
    return {name: [(n, USUAL | own) for n, own in cases] for name, cases in of.items()}


def plot(found: dict[str, list[tuple[int, dict[str, float]]]], file: Path) -> None:
    """Seconds of a step and memory, both on logarithmic axes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(
        2, len(found), figsize=(4 * len(found), 6), squeeze=False, sharex="col", sharey="row"
    )
    for (name, cases), (above, below) in zip(found.items(), axes.T, strict=True):
        x = [number for number, _ in cases]
        above.loglog(x, [case["step"] for _, case in cases], "o-", label="a step")
        above.loglog(x, [case["compile"] for _, case in cases], "s:", label="compiling")
        below.loglog(x, [case["after"] / 1e9 for _, case in cases], "o-", label="largest")
        below.loglog(x, [case["before"] / 1e9 for _, case in cases], "s:", label="before the fit")
        below.loglog(x, [case["input"] / 1e9 for _, case in cases], "^:", label="images alone")
        below.set_xlabel("pixels, averaged to 20 000" if name == "averaged" else name)
        below.set_xticks(x, [f"{number:g}" for number in x])
        below.minorticks_off()
    axes[0, 0].set_ylabel("s")
    axes[1, 0].set_ylabel("GB")
    for row in axes:
        row[0].legend()
    figure.tight_layout()
    figure.savefig(file, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plot", type=Path, help="a file for the figure")
    parser.add_argument("--largest", type=float, default=max(PIXELS), help="pixels of the largest picture")
    parser.add_argument("--only", choices=SERIES, help="one of the series")
    parser.add_argument("--case", nargs=4, type=int, help=argparse.SUPPRESS)
    parser.add_argument("--pictures", nargs="+", type=float, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.pictures:
        pixels, *suns = asked.pictures
        print(*(picture(int(pixels), zenith) for zenith in suns))
        return
    if asked.case:
        print(json.dumps(measure(*asked.case)))
        return
    found: dict[str, list[tuple[int, dict[str, float]]]] = {}
    for name, cases in series(asked.largest).items():
        if asked.only not in (None, name):
            continue
        table = Table(
            name, "a step, s", "compiling, s", f"fit of {STEPS} steps, s", "largest, GB", "before the fit, GB",
            "images, GB", "the fit adds, bytes per pixel", title=f"{processor()}, jax {jax.__version__}",
        )  # fmt: skip
        found[name] = []
        for number, case in cases:
            alone("--pictures", str(case["pixels"]), *(repr(float(zenith)) for zenith in zeniths(case["images"])))
            cost = json.loads(alone("--case", *(str(case[key]) for key in USUAL)))
            found[name].append((number, cost))
            print(name, case, {key: float(f"{value:.4g}") for key, value in cost.items()}, flush=True)
            # What the fit of a small picture adds is the compiler's.
            added, floor = (c["after"] - c["before"] for c in (cost, found[name][0][1]))
            more = (cost["input"] - found[name][0][1]["input"]) / 12
            table.add_row(
                f"{number:g}",
                f"{cost['step']:.3g}",
                f"{cost['compile']:.0f}",
                f"{cost['total']:.0f}",
                *(f"{cost[key] / 1e9:.2f}" for key in ("after", "before", "input")),
                f"{(added - floor) / more:.0f}" if more else "",
            )
        Console(width=140).print(table)
    if asked.plot:
        plot(found, asked.plot)


if __name__ == "__main__":
    main()
