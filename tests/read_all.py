"""Read every file of a folder, in at most 4 GB: a line of JSON for each, with what came of it and how long it took."""

import json
import resource
import sys
import time
from pathlib import Path

MEMORY = 4 * 2**30


def main(folder: Path) -> None:
    from diffatmo import imageio

    for path in sorted(folder.iterdir()):
        before = time.perf_counter()
        try:
            image = imageio.read_image(path, transfer=None if path.name.startswith("linear") else "srgb")
            kind, text = "image", f"{image.pixels.dtype} {image.pixels.shape}"
        except imageio.ImageError as error:
            kind, text = "error", str(error)
        except Exception as error:
            kind, text = "crash", repr(error)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        report = {"name": path.name, "kind": kind, "text": text, "seconds": time.perf_counter() - before, "peak": peak}
        print(json.dumps(report), flush=True)


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    main(Path(sys.argv[1]))
