"""Where the images that come with diffatmo lie."""

from pathlib import Path

import diffatmo
from diffatmo.cli.common import InputError


def scenes() -> list[Path]:
    """The scene files of the shipped set, ``data_synthetic/<atmosphere>/scene.toml``.

    A wheel carries the set inside the package; in a checkout, and so in an editable installation, it lies beside it.
    """
    package = Path(diffatmo.__file__).parent
    for directory in (package / "data_synthetic", package.parent / "data_synthetic"):
        found = sorted(directory.glob("*/scene.toml"))
        if found:
            return found
    raise InputError("the shipped images are not installed; name images to fit, or give --config SCENE.toml")
