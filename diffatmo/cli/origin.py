"""What a result was made from, kept beside it, so that it need not be made twice.

``origin.json`` is the last file written into a folder of results and the first to go when they are replaced: where it
is, the results are complete, and of what it says. It holds

===========  ================================================================================================
``schema``   ``"diffatmo-origin"``
``version``  of diffatmo
``file``     the image, as it was named
``image``    SHA-256 of its contents; of those of the files of a bracket, one after the other
``options``  all that was said about the fit, by key; a file that was named is there with the SHA-256 of its contents
===========  ================================================================================================
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from diffatmo import __version__
from diffatmo.cli.common import printable
from diffatmo.cli.scenefile import FitSpec

FILE = "origin.json"
SCHEMA = "diffatmo-origin"


def describe(spec: FitSpec) -> dict[str, Any]:
    """What a fit of the one image of ``spec`` depends on, as plain JSON. Raises ``OSError`` if a file cannot be read."""
    (image,) = spec.images
    said = {item.name: getattr(spec, item.name) for item in dataclasses.fields(spec) if item.name != "images"}
    # What goes without saying changes with the version only.
    options = {key: _plain(value) for key, value in {**said, **image.options}.items() if value is not None}
    return {
        "schema": SCHEMA,
        "version": __version__,
        "file": printable(image.file),
        "image": _digest(*image.files),
        "options": options,
    }


def dumps(spec: FitSpec) -> str:
    """The contents of ``origin.json``."""
    return json.dumps(describe(spec), indent=1) + "\n"


def difference(directory: Path, spec: FitSpec) -> str | None:
    """Why the results in ``directory`` are not those of ``spec``, in words; None if they are."""
    found = _read(directory / FILE)
    if found is None:
        return "not complete"
    try:
        wanted = describe(spec)
    except OSError as error:
        return f"the image cannot be read: {error.strerror}"
    if found["version"] != wanted["version"]:
        return f"made by version {found['version']}, this is {wanted['version']}"
    if found["image"] != wanted["image"]:
        return "the image has changed"
    before, now = found["options"], wanted["options"]
    changed = [key for key in {**before, **now} if before.get(key) != now.get(key)]
    return "; ".join(f"{key} was {_shown(before.get(key))}, is {_shown(now.get(key))}" for key in changed) or None


def made_in(output: Path) -> dict[Path, Path]:
    """The folders in ``output`` with complete results, and the image of each as it was named."""
    found = {path.parent: _read(path) for path in sorted(output.glob(f"*/{FILE}"))}
    return {directory: Path(origin["file"]) for directory, origin in found.items() if origin}


def _read(path: Path) -> dict[str, Any] | None:
    """What ``path`` says; None if there is no such file, or it is damaged."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    kinds = {"schema": str, "version": str, "file": str, "image": str, "options": dict}
    if not isinstance(found, dict) or found.get("schema") != SCHEMA:
        return None
    return found if all(isinstance(found.get(key), kind) for key, kind in kinds.items()) else None


def _plain(value: Any) -> Any:
    """``value`` in JSON's types; texts that name files as what is in them."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: _plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, str | Path) and _is_file(value):
        return {"sha256": _digest(Path(value))}
    return value if value is None or isinstance(value, str | bool | int | float) else str(value)


def _is_file(name: str | Path) -> bool:
    try:
        return Path(name).is_file()
    except (OSError, ValueError):
        # Too long for a file name, or with a zero in it.
        return False


def _digest(*paths: Path) -> str:
    digest = hashlib.sha256()
    for path in paths:
        with open(path, "rb") as file:
            hashlib.file_digest(file, lambda: digest)
    return digest.hexdigest()


def _shown(value: Any) -> str:
    if isinstance(value, dict) and set(value) == {"sha256"}:
        return f"a file ({value['sha256'][:8]})"
    return "not given" if value is None else json.dumps(value)
