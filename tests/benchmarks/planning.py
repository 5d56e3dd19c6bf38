"""Are the promises of a plan kept? Cramér-Rao bounds against those of the design, and its first advice followed.

python tests/benchmarks/planning.py [REALISATIONS]

The design's table was made by a prototype with another number of pixels, so one common factor is taken out before the two are
compared. The advice is followed as often as there are realisations of the noise: fits of two simulated skies, alone
and with the shot recommended, say by how much their error bars shrink, and their errors whether those can be believed.
"""

import math
import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import fitting
from diffatmo.compiling import outermost
from diffatmo.models import Moments
from diffatmo.render import Scene, render
from fitting import planning
from fitting.parameters import select
from fitting.planning import Photo

sys.path.insert(0, str(Path(__file__).parents[2] / "data_synthetic"))
import generate

TRUTH = generate.ATMOSPHERES["clear"]
"""Aerosol optical depth 0.12."""
NUMBERS = (
    "rayleigh_scattering",
    "rayleigh_scale_height",
    "mie_scattering",
    "mie_scale_height",
    "mie_g",
    "ozone_absorption",
    "ground_albedo",
    "rayleigh_optical_depth",
    "mie_optical_depth",
)
FREE = NUMBERS[:7]
SCALARS = ("rayleigh_scale_height", "mie_scale_height", "mie_g")
TIE = dict.fromkeys(("mie_scattering", "ozone_absorption", "ground_albedo"), "start")
DESIGN = {
    "calibrated": (20, 20, 21, 20, 0.1, 8, 7, 1.6, 1.2),
    "+ unknown exposure": (21, 21, 22, 21, 0.1, 9, 9, 2.9, 2.5),
    "+ unknown white balance": (40, 38, 43, 38, 0.1, 150, 12, 4.3, 5.8),
    "one photo away from the sun": (49, 61, 52, 50, 40, 189, 125, 45, 42),
    "3 sun heights, shared white balance": (11, 11, 13, 12, 0.1, 2.6, 1.3, 0.6, 1.4),
    "+ one twilight image (93°)": (1, 1, 2, 1.5, 0.1, 0.7, 1.1, 0.4, 0.7),
}
"""Standard errors, %, of a full-sky image with 2 % noise."""

SIZE = 64
"""Pixels across a photo that is simulated."""
NOISE = 0.01


def _sky(zenith_deg: float, exposure: str) -> Photo:
    return Photo(planning.WHOLE_SKY, math.radians(zenith_deg), exposure, bracketed=True)


def bounds(console: Console) -> None:
    """The design's table beside our own."""
    parameters = select(TRUTH, FREE, TIE)
    shared = "camera-per-channel"
    shots = [
        _sky(60, "fixed"),
        _sky(60, "free"),
        _sky(60, "free-per-channel"),
        Photo(
            "away", math.radians(60), "free-per-channel", math.radians(50), math.pi, math.radians(30), bracketed=True
        ),
        *(_sky(zenith, shared) for zenith in (30, 60, 80, 93)),
    ]
    sensor = planning.Sensor(noise=0.02)
    parts = planning.of_shots(shots, parameters, Moments(), sensor=sensor, altitude=generate.ALTITUDE_KM)
    question, named, values = planning.ask(parameters, NUMBERS)
    table = Table(
        "what is known", *NUMBERS, title=f"standard errors, %: ours ({sensor.pixels:g} pixels) / the design's"
    )
    ours = []
    for (name, theirs), known in zip(
        DESIGN.items(), [[parts[0]], [parts[1]], [parts[2]], [parts[3]], parts[4:7], parts[4:]], strict=True
    ):
        errors = question.errors(planning.combined(known))
        row = [planning.relative(named, values, errors, number) for number in NUMBERS]
        found = [math.nan if error is None else 100 * error for error in row]
        ours.append(found)
        table.add_row(name, *(f"{own:.2g} / {wanted:g}" for own, wanted in zip(found, theirs, strict=True)))
    console.print(table)
    ratio = np.log(np.array(list(DESIGN.values())) / np.array(ours))
    ranks = [np.argsort(np.argsort(np.ravel(x), kind="stable")) for x in (ours, list(DESIGN.values()))]
    console.print(
        f"rank correlation {np.corrcoef(*ranks)[0, 1]:.3f}; design / ours: common factor {math.exp(ratio.mean()):.1f}, "
        f"beyond it a factor {math.exp(ratio.std()):.2f} (RMS)"
    )


def simulated(photo: Photo, seed: int, name: str) -> fitting.Observation:
    """A photo taken of the truth; its exposure is the median of its light."""
    camera = photo.camera(SIZE)
    scene = Scene(TRUTH, camera, generate.ALTITUDE_KM, photo.towards_sun)
    light = np.asarray(outermost(render)(scene, Moments()), dtype=np.float64)
    rng = np.random.default_rng(seed)
    noisy = light * (1 + NOISE * rng.standard_normal(light.shape))
    settings = {} if photo.bracketed else {"saturation": 8 * float(np.median(light[np.asarray(camera.valid())]))}
    return fitting.observe(
        noisy,
        camera=camera,
        altitude=generate.ALTITUDE_KM,
        sun=photo.towards_sun,
        noise=NOISE,
        exposure=photo.exposure,
        name=name,
        **settings,
    )


def followed(console: Console, count: int, exposure: str, aims: tuple[str, ...]) -> None:
    """Follow the first advice, and compare what the fits then say, and how they scatter, with what was promised."""
    first = [_sky(zenith, exposure) for zenith in (40.0, 70.0)]
    taken = [simulated(photo, number, f"photo {number}") for number, photo in enumerate(first)]
    shots = [shot for shot in planning.candidates(exposures=[exposure]) if isinstance(shot, Photo)]
    advice = planning.plan(taken, atmosphere=TRUTH, free=FREE, tie=TIE, aims=aims, shots=shots, count=0).ranking[0]
    photo = advice.shot
    assert isinstance(photo, Photo)

    def fitted(photos: list[Photo], seed: int) -> tuple[np.ndarray, float]:
        """Error bars of the numbers of every aim, tied ones once, and the square of their errors in units of these."""
        images = [simulated(photo, 1000 * seed + number, f"photo {number}") for number, photo in enumerate(photos)]
        result = fitting.fit(images, init=TRUTH, free=FREE, tie=TIE, refine=False).with_truth(TRUTH)
        estimates = [
            estimate
            for aim in aims
            for estimate in [e for e in result.parameters if e.field == aim][: 1 if aim in TIE else None]
        ]
        rows = [result.covariance_names.index(estimate.name) for estimate in estimates]
        bars = np.array([estimate.standard_error for estimate in estimates])
        pulls = np.array([estimate.pull for estimate in estimates])
        correlation = result.covariance[np.ix_(rows, rows)] / np.outer(bars, bars)
        return bars, pulls @ np.linalg.solve(correlation, pulls) / len(pulls)

    runs = [[fitted(photos, seed) for seed in range(count)] for photos in (first, [*first, photo])]
    weight = np.concatenate([[1.0] if aim in TIE or aim in SCALARS else [1 / 3] * 3 for aim in aims]) / len(aims)
    logs = [np.mean([np.log(bars) for bars, _ in run], axis=0) for run in runs]
    gain = math.exp(weight @ (logs[0] - logs[1]))
    sizes = [math.sqrt(np.mean([square for _, square in run])) for run in runs]
    console.print(
        f"for {'all' if aims == FREE else ', '.join(aims)}, exposures {exposure}: {photo.name}; promised {advice.gain:.2f}; "
        f"error bars of {count} fits {gain:.2f}, {gain / advice.gain:.3f} of it; errors over error bars before "
        f"{sizes[0]:.2f}, after {sizes[1]:.2f} (± {1 / math.sqrt(2 * count * len(weight)):.2f})"
    )


def main(count: int) -> None:
    console, started = Console(width=170), time.perf_counter()
    bounds(console)
    for exposure, aims in (("fixed", FREE), ("free", FREE), ("fixed", ("mie_g",)), ("free", ("ozone_absorption",))):
        followed(console, count, exposure, aims)
    console.print(f"{time.perf_counter() - started:.0f} s")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 12)
