"""What each approximation costs: fit the shipped skies with every model and see where it puts the parameters.

The skies are Monte Carlo of all orders, with the noise of a sensor. A model that leaves light out must make up for it, and
does so with the wrong aerosol, ground or ozone; its small error bars do not tell. Bruneton's tables are those of
``Bruneton.reduced()``.

python examples/model_biases.py [MODEL,...] [NAME,...]
"""

import sys
import time
import tomllib
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import diffatmo
import fitting
from diffatmo import scene
from diffatmo.models import Bruneton, Hillaire, Moments, RayMarch

SHIPPED = Path(__file__).resolve().parent.parent / "data_synthetic"
MODELS = {"moments": Moments(), "bruneton": Bruneton.reduced(), "hillaire": Hillaire(), "raymarch": RayMarch()}
SHOWN_NM = 550.0


def observations(folder: Path) -> list[fitting.Observation]:
    """The pictures of a folder with the noise their headers state."""
    seen = []
    for path in sorted(folder.glob("sky_*.exr")):
        pixels, place, notes = scene.load(path)
        gain = notes["electrons_per_unit"]
        seen.append(
            fitting.observe(
                pixels,
                camera=place.camera,
                altitude=place.altitude,
                sun=place.sun,
                noise=notes["monte_carlo_relative_standard_error"],
                noise_shot=1 / gain,
                noise_floor=notes["read_noise_electrons"] / gain,
                sun_exclusion=np.radians(2.0),
                name=path.stem,
            )
        )
    return seen


def main(models: str = ",".join(MODELS), names: str = "clear,hazy", width: str = "110") -> dict[str, fitting.FitResult]:
    console, results = Console(width=int(width)), {}
    for name in names.split(","):
        folder = SHIPPED / name
        truth, start = (diffatmo.load(folder / file) for file in ("truth.toml", "start.toml"))
        pictures, wanted = observations(folder), tomllib.loads((folder / "scene.toml").read_text(encoding="utf-8"))
        free, tie = wanted["free"], wanted["tie"]
        for model in models.split(","):
            before = time.perf_counter()
            result = fitting.fit(pictures, init=start, free=free, tie=tie, model=MODELS[model]).with_truth(truth)
            results[f"{name}/{model}"] = result
            console.print(
                f"{name}, {model}: reduced χ² {result.reduced_chi2:.3g}, {result.message} "
                f"({result.iterations} steps, {time.perf_counter() - before:.0f} s)"
            )
        table = Table(
            "parameter", *models.split(","), title=f"{name}: relative error of what was found, and its error bar, %"
        )
        fitted = [results[f"{name}/{model}"] for model in models.split(",")]
        for rows in zip(*(result.parameters for result in fitted), strict=True):
            if rows[0].wavelength not in (None, SHOWN_NM):
                continue
            cells = []
            for estimate in rows:
                off = 100 * (estimate.value / estimate.truth - 1)
                error = estimate.standard_error
                bar = "–" if error is None else f"{100 * error / abs(estimate.truth):.2g}"
                cells.append(f"{off:+.3g} ± {bar}")
            table.add_row(rows[0].name, *cells)
        console.print(table)
    return results


if __name__ == "__main__":
    main(*sys.argv[1:])
