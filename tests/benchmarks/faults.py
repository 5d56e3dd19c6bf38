"""Kill joint fits at any moment and go on with them: what is lost, what is left, and whether the result is the same.

python tests/benchmarks/faults.py [--fits 3] [--kills 5]

Each fit is killed (-9) up to so many times at random moments, from before the first step to the writing of the report, and
resumed each time. A step that was shown as done must not be done again, files must be whole or absent, and the numbers in the
end those of a fit that nobody disturbed.
"""

import argparse
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

import diffatmo
from diffatmo import atmosphere, imageio, models, render, scene, sun

ROOT = Path(__file__).parents[2]
STEP = re.compile(r"step +(\d+) ")
ZENITHS_DEG = (30.0, 60.0, 80.0)


def prepare(folder: Path) -> Path:
    """A scene of three images of single scattering, of which the fit takes some ten steps."""
    air, rng = diffatmo.earth(), np.random.default_rng(0)
    tables = []
    for zenith in ZENITHS_DEG:
        seen = diffatmo.Scene(
            air,
            diffatmo.Equirectangular(24, 48, upper=True),
            0.1,
            sun.direction(zenith=np.radians(zenith), azimuth=1.0),
        )
        pixels = np.asarray(render.render(seen, models.RayMarch()))
        noisy = (pixels * (1 + 0.01 * rng.standard_normal(pixels.shape))).astype(np.float32)
        scene.save(folder / f"sky_{zenith:g}.exr", noisy, seen, notes={"noise": 0.01, "model": "raymarch"})
        tables.append(f'[[image]]\nfile = "sky_{zenith:g}.exr"\n')
    keys = atmosphere.to_dict(air)
    off = {name: [3.0 * value for value in keys[name]] for name in ("mie_scattering_per_km", "mie_absorption_per_km")}
    start = atmosphere.from_dict(keys | off | {"mie_g": 0.5, "mie_scale_height_km": 2.5})
    atmosphere.save(start, folder / "start.toml")
    free = '["rayleigh_scattering", "rayleigh_scale_height", "mie_scattering", "mie_scale_height", "mie_g"]'
    file = folder / "scene.toml"
    file.write_text(f'init = "start.toml"\nmodel = "raymarch"\nfree = {free}\n' + "".join(tables))
    return file


def command(config: Path, output: Path, *options: str) -> subprocess.Popen:
    environment = os.environ | {
        "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(config.parent / "cache"), "PYTHONUNBUFFERED": "1"
    }  # fmt: skip
    arguments = [sys.executable, "-m", "diffatmo", "fit", "--config", str(config), "-o", str(output), *options]
    return subprocess.Popen(
        arguments, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def steps(said: str) -> list[int]:
    return [int(number) for number in STEP.findall(said)]


def check_whole(output: Path) -> None:
    """Every file that is there can be read."""
    for file in output.glob("*"):
        if file.name.startswith("."):
            continue
        if file.suffix == ".json":
            json.loads(file.read_text())
        elif file.suffix == ".toml":
            atmosphere.load(file)
        elif file.suffix in (".exr", ".png"):
            imageio.read_image(file, transfer="srgb" if file.suffix == ".png" else None)
        elif file.suffix == ".html":
            assert file.read_text().rstrip().endswith("</html>"), file


def numbers(output: Path) -> np.ndarray:
    found = json.loads((output / "fit.json").read_text())
    assert found["converged"]
    spread = [
        np.ravel([estimate[key]]) for estimate in found["parameters"].values() for key in ("value", "standard_error")
    ]
    return np.stack([np.concatenate(spread[::2]), np.concatenate(spread[1::2])], axis=-1)


def main() -> None:
    parser = argparse.ArgumentParser()
    for name, default in {"fits": 3, "kills": 5}.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    given = parser.parse_args()
    chance, phases, again = random.Random(1), Counter[str](), 0
    with tempfile.TemporaryDirectory() as name:
        config = prepare(Path(name))
        for run in ("cold", "whole"):
            began = time.monotonic()
            said, _ = command(config, Path(name) / run).communicate()
            length = time.monotonic() - began
        whole = numbers(Path(name) / "whole")
        print(f"undisturbed: {len(steps(said))} steps in {length:.1f} s", flush=True)
        for fit in range(given.fits):
            output, done = Path(name) / f"killed_{fit}", -1
            for kill in range(given.kills + 1):
                process = command(config, output, "--resume")
                if kill < given.kills:
                    try:
                        process.wait(chance.uniform(0.2, 1.05) * length)
                    except subprocess.TimeoutExpired:
                        os.killpg(process.pid, signal.SIGKILL)
                said, _ = process.communicate()
                seen = steps(said)
                again += sum(step <= done for step in seen)
                done = max([done, *seen])
                if process.returncode == 0 or "the fit here is complete" in said:
                    phases["finished" if process.returncode == 0 else "done, but for the table"] += 1
                    break
                if process.returncode != -signal.SIGKILL:
                    raise SystemExit(f"status {process.returncode}:\n{said}")
                written = any(output.glob("*.exr")) if output.exists() else False
                phases["writing" if written else "stepping" if seen else "starting"] += 1
                if output.exists():
                    check_whole(output)
            check_whole(output)
            off = np.max(np.abs(numbers(output)[:, 0] - whole[:, 0]) / whole[:, 1])
            left = [file.name for file in output.iterdir() if file.name.startswith(".") or "checkpoint" in file.name]
            print(f"fit {fit}: off by {off:.1e} error bars from the undisturbed one, left over: {left}", flush=True)
        print(f"ended while {dict(phases)}; steps done twice although shown: {again}")


if __name__ == "__main__":
    main()
