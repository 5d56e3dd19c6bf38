"""Fit a folder of skies of which one in twenty is no image, and kill such runs: what is found, what it costs, what is lost.

python tests/benchmarks/folder.py [--count 200] [--subset 20] [--kills 10]
"""

import argparse
import csv
import os
import random
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

import diffatmo
from diffatmo import atmosphere, models, render, scene, sun

ROOT = Path(__file__).parents[2]
NOISE = 0.01
FREE = ("rayleigh_scattering", "mie_scattering", "mie_g")
DAMAGES = ("cut short", "NaN", "text", "empty")


def make_skies(folder: Path, count: int, air: diffatmo.Atmosphere) -> None:
    """Skies of 16 × 32 pixels, by single scattering, under suns of all heights; every twentieth is damaged."""
    folder.mkdir()
    camera, model, rng = diffatmo.Equirectangular(16, 32), models.RayMarch(), np.random.default_rng(0)
    for number in range(count):
        towards = sun.direction(zenith=rng.uniform(0.3, 1.4), azimuth=rng.uniform(0, 6))
        seen = diffatmo.Scene(air, camera, 0.1, towards)
        pixels = np.asarray(render.render(seen, model))
        pixels = pixels * (1 + NOISE * rng.standard_normal(pixels.shape))
        path = folder / f"sky_{number:04}.exr"
        damage = DAMAGES[number // 20 % 4] if number % 20 == 10 else None
        pixels = np.full_like(pixels, np.nan) if damage == "NaN" else pixels
        scene.save(path, pixels.astype(np.float32), seen, notes={"noise": NOISE, "model": "raymarch"})
        if damage == "cut short":
            path.write_bytes(path.read_bytes()[:-500])
        elif damage == "text":
            path.write_text("not an image\n")
        elif damage == "empty":
            path.write_bytes(b"")


def start(folder: Path, output: Path, *options: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "diffatmo", "fit", str(folder), "-o", str(output), "--model", "raymarch"]
    command += ["--free", ",".join(FREE), "--init", str(folder.parent / "start.toml"), *options]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(folder.parent / "cache")}
    log = open(output.with_suffix(".log"), "a")  # noqa: SIM115
    with log:
        return subprocess.Popen(command, env=environment, stdout=log, stderr=log, start_new_session=True)


def finish(process: subprocess.Popen) -> tuple[int, float]:
    """Exit status, and the memory of the largest of its processes in MB."""
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, usage.ru_maxrss / 1024


def measure(title: str, folder: Path, output: Path, *options: str) -> None:
    began = time.monotonic()
    status, memory = finish(start(folder, output, *options))
    seconds, states = time.monotonic() - began, Counter(row["status"] for row in rows(output))
    print(
        f"{title}: {dict(states)}, exit status {status}, {seconds:.0f} s, largest process {memory:.0f} MB", flush=True
    )


def rows(output: Path) -> list[dict[str, str]]:
    with open(output / "results.csv", newline="") as file:
        return list(csv.DictReader(file))


def pulls(output: Path, air: diffatmo.Atmosphere) -> list[float]:
    """(found - true) / standard error of every number that was fitted."""
    truth = {"mie_g": float(air.mie_g)}
    for name in ("rayleigh_scattering", "mie_scattering"):
        truth |= {f"{name}_{nm:g}": float(v) for nm, v in zip(air.wavelengths, getattr(air, name), strict=True)}
    found = [row for row in rows(output) if row["status"] == "converged"]
    return [
        (float(row[name]) - value) / float(row[f"{name}_standard_error"])
        for row in found
        for name, value in truth.items()
        if row[f"{name}_standard_error"]
    ]


def kill_again_and_again(folder: Path, output: Path, whole: Path, kills: int) -> None:
    """kill -9 of the run, or of the process that fits, at any time; then resume, until there is no more to be done."""
    chance = random.Random(0)
    hit: Counter[str] = Counter()
    for number in range(kills):
        process = start(folder, output, "--jobs", "2", "--resume")
        time.sleep(chance.uniform(2, 14))
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        if number % 2 and len(children) > 1:
            hit["a process that fits"] += 1
            os.kill(int(children[-1]), signal.SIGKILL)
            time.sleep(1)
        elif process.poll() is None:
            hit["the run"] += 1
        if process.poll() is None:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
    status, _ = finish(start(folder, output, "--jobs", "2", "--resume"))

    def content(output: Path) -> list[dict[str, str]]:
        return [{key: value for key, value in row.items() if key != "seconds"} for row in rows(output)]

    same = content(output) == content(whole)
    left = [path for path in output.rglob("*") if ".part" in path.name]
    print(
        f"killed, {dict(hit)}: exit status {status} in the end, table as without kills: {same}, left over: {len(left)}"
    )


def main() -> None:
    parser = argparse.ArgumentParser()
    for name, default in {"count": 200, "subset": 20, "kills": 10}.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    given = parser.parse_args()
    air = diffatmo.earth()
    with tempfile.TemporaryDirectory() as name:
        folder, subset = Path(name) / "skies", Path(name) / "subset"
        keys = atmosphere.to_dict(air)
        off = {key: [1.3 * x for x in keys[key]] for key in ("rayleigh_scattering_per_km", "mie_scattering_per_km")}
        atmosphere.save(atmosphere.from_dict(keys | off | {"mie_g": 0.6}), Path(name) / "start.toml")
        make_skies(folder, given.count, air)
        subset.mkdir()
        for path in sorted(folder.iterdir())[: given.subset]:
            shutil.copy(path, subset)
        measure(f"{given.subset} images, nothing compiled before, 1 job", subset, Path(name) / "cold", "--jobs", "1")
        for jobs in ("1", "2"):
            measure(f"{given.subset} images, {jobs} at a time", subset, Path(name) / f"by_{jobs}", "--jobs", jobs)
        kill_again_and_again(subset, Path(name) / "killed", Path(name) / "by_1", given.kills)
        measure(f"{given.count} images", folder, Path(name) / "all")
        found = pulls(Path(name) / "all", air)
        print(f"pulls: mean {statistics.mean(found):+.2f}, standard deviation {statistics.stdev(found):.2f}")
        for row in rows(Path(name) / "all"):
            if row["status"] == "failed":
                print(row["message"].replace(f"{name}/", ""))


if __name__ == "__main__":
    main()
