"""The layering: a module imports only from the levels above it in the table, and `--help` imports almost nothing."""

import ast
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import diffatmo
from diffatmo.cli import common, export, keys, scenefile

ROOT = Path(__file__).parent.parent

# One row per level; a module may import from any earlier row, never from its own. A package's own name means its
# __init__.py.
LEVELS = [
    ["diffatmo._types", "diffatmo._names", "diffatmo.constants", "diffatmo.compiling", "diffatmo.folders"],
    ["diffatmo.numerics", "diffatmo.saturation", "diffatmo.features"],
    ["diffatmo.ephemeris", "diffatmo.horizon"],
    [
        f"diffatmo.{name}"
        for name in ("geometry", "phase", "table", "spectrum", "color", "codecs", "camera", "sun", "exif")
    ],
    ["diffatmo.rays", "diffatmo.atmosphere", "diffatmo.raw", "diffatmo.brackets", "diffatmo.bands", "diffatmo.scan"],
    ["diffatmo.transmittance"],
    ["diffatmo.scattering"],
    ["diffatmo.models.base", "diffatmo.models.tables"],
    ["diffatmo.models.transmittance_table"],
    [
        f"diffatmo.models.{name}"
        for name in ("moments.angular", "pathtrace.columns", "pathtrace.lattice", "pathtrace.slab")
    ],
    ["diffatmo.models.moments.shell", "diffatmo.models.pathtrace.vector", "diffatmo.models.pathtrace.guide"],
    ["diffatmo.models.moments.solve", "diffatmo.models.pathtrace.paths", "diffatmo.models.bruneton.precomputation"],
    ["diffatmo.models.hillaire.luts"],
    ["diffatmo.models.moments.sky"],
    [f"diffatmo.models.{name}" for name in ("raymarch", "moments", "bruneton", "hillaire", "pathtrace")],
    ["diffatmo.presets.fields"],
    ["diffatmo.presets.layers", "diffatmo.presets.unreal", "diffatmo.presets.blender"],
    ["diffatmo.presets.three_geospatial", "diffatmo.presets.bruneton"],
    ["diffatmo.models"],
    ["diffatmo.presets"],
    ["diffatmo.render", "diffatmo.imageio", "diffatmo.skymask"],
    ["diffatmo.scene", "diffatmo.comparison", "diffatmo.export"],
    ["fitting._errors"],
    ["fitting.bijections", "fitting.quantities", "fitting.mixing"],
    ["fitting.parameters", "fitting.observation"],
    ["fitting.priors", "fitting.robust", "fitting.checkpoint", "fitting.nuisances"],
    ["fitting.batch"],
    ["fitting.smooth", "fitting.correction"],
    ["fitting.problem"],
    ["fitting.linearisation"],
    ["fitting.least_squares", "fitting.devices"],
    ["fitting.elimination"],
    ["fitting.starts", "fitting.search"],
    ["fitting.model_error"],
    ["fitting.evaluation"],
    ["fitting.run"],
    ["fitting.passes"],
    ["fitting.solve"],
    ["fitting.findings"],
    ["fitting.combinations"],
    ["fitting.tables", "fitting.figures", "fitting.prediction", "fitting.storage"],
    ["fitting.report", "fitting.result"],
    ["fitting.uncertainty"],
    ["fitting.planning", "fitting.profiles"],
    ["fitting"],
    ["diffatmo"],  # the lazy public interface
    ["diffatmo.cli", "diffatmo.cli.cache", "diffatmo.cli.common", "diffatmo.cli.workers"],
    ["diffatmo.cli.keys", "diffatmo.cli.shipped", "diffatmo.cli.results", "diffatmo.cli.colours"],
    ["diffatmo.cli.scenefile"],
    ["diffatmo.cli.photo", "diffatmo.cli.bracket"],
    ["diffatmo.cli.scans"],
    ["diffatmo.cli.images", "diffatmo.cli.origin"],
    ["diffatmo.cli.many", "diffatmo.cli.jobs"],
    ["diffatmo.cli.radiance", "diffatmo.cli.render", "diffatmo.cli.running"],
    ["diffatmo.cli.fit"],
    ["diffatmo.cli.compare", "diffatmo.cli.export", "diffatmo.cli.plan"],
    ["diffatmo.cli.imports"],
    ["diffatmo.cli.main"],
    ["diffatmo.__main__"],
]
LEVEL = {module: number for number, modules in enumerate(LEVELS) for module in modules}


def modules() -> dict[str, Path]:
    found = {}
    for package in ("diffatmo", "fitting"):
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def imports(path: Path) -> set[str]:
    """The project's modules that the file at `path` imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in MODULES else node.module for name in names}
    return {name for name in found if name.split(".")[0] in ("diffatmo", "fitting")}


def test_every_module_has_a_level():
    assert set(MODULES) == set(LEVEL)


@pytest.mark.parametrize("module", [name for name in MODULES if name != "diffatmo"])
def test_imports_point_down(module):
    above = {name for name in imports(MODULES[module]) if LEVEL[name] >= LEVEL[module]}
    assert not above, f"{module} may not import {sorted(above)}"


@pytest.mark.parametrize("module", [name for name in MODULES if name.startswith("diffatmo")])
def test_only_the_command_line_sees_fitting(module):
    if not module.startswith("diffatmo.cli"):
        assert not {name for name in imports(MODULES[module]) if name.startswith("fitting")}


COMMON = ("base", "tables", "transmittance_table")
"""What several models build on."""


def model(module: str) -> str | None:
    """The model a module belongs to."""
    parts = module.split(".")
    return parts[2] if parts[:2] == ["diffatmo", "models"] and len(parts) > 2 and parts[2] not in COMMON else None


@pytest.mark.parametrize("module", [name for name in MODULES if model(name)])
def test_models_do_not_import_each_other(module):
    assert {model(name) for name in imports(MODULES[module])} <= {None, model(module)}


def test_public_names_resolve():
    for name in diffatmo.__all__:
        assert getattr(diffatmo, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        diffatmo.nothing  # noqa: B018


def test_model_names_of_the_command_line():
    from diffatmo import camera, models, presets
    from diffatmo.models import tables
    from fitting import robust

    assert tuple(models.MODELS) == common.MODELS
    assert set(scenefile.MODELS) == set(models.MODELS) - {"pathtrace"}
    assert robust.LOSSES == scenefile.LOSSES
    assert tuple(camera.MAPPINGS) == keys.MAPPINGS
    assert export.PARAMETERISATIONS == tables.PARAMETERISATIONS
    assert tuple(presets.TARGETS) == export.PRESETS


def test_help_imports_no_jax():
    code = (
        "import sys; from diffatmo.cli.main import main; main(['fit', '--help']); "
        "sys.exit(any(name in sys.modules for name in ('jax', 'numpy', 'rich', 'matplotlib')))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, cwd=ROOT)


def test_help_answers_within_half_a_second():
    """Of processor time, which other programs on the machine do not lengthen as they do the time of a clock."""

    def seconds() -> float:
        before = os.times()
        subprocess.run([sys.executable, "-m", "diffatmo", "--help"], check=True, capture_output=True, cwd=ROOT)
        after = os.times()
        return after.children_user + after.children_system - before.children_user - before.children_system

    assert min(seconds() for _ in range(5)) < 0.5


def test_version_is_stated_once_and_repeated_truly():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert project["project"]["dynamic"] == ["version"]
    assert f"\nversion: {diffatmo.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\n## {diffatmo.__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_constraints_cover_every_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = [name for group in project["optional-dependencies"].values() for name in group]
    named = {name.split(">=")[0].lower() for name in project["dependencies"] + extras}
    needed = {name for name in named if not name.startswith("diffatmo[")}
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {line.split("==")[0].lower().replace("_", "-") for line in lines if not line.startswith("#")}
    assert needed <= pinned
