"""How the project is put together: imports point down, the checkout and the wheel hold the same, data stays data."""

import ast
import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import gen2d

ROOT = Path(gen2d.__file__).parent.parent
PACKAGE = ROOT / "gen2d"
# Each module may import those before it; a family or look may import all of a Python file's neighbours but the last.
ORDER = [
    *("core", "storage", "dataset", "loading", "trust", "preview", "complete"),
    *(
        "verification",
        "report",
        "words",
        "films",
        "exports",
        "exporting",
        "types",
        "shapes",
        "tournament",
        "tables",
        "folds",
        "contacts",
        "impacts",
        "rows",
    ),
    *("ledger", "joints", "linkage", "forms", "sweeps", "events", "near", "dense", "sparse", "solver", "scenery"),
    *(
        "simulate",
        "distributions",
        "cuts",
        "factors",
        "quality",
        "laws",
        "predictability",
        "plugins",
        "options",
        "splits",
        "parts",
        "matched",
        "config",
        "config",
        "sampling",
    ),
    *(
        "coverage",
        "paint",
        "camera",
        "figures",
        "picture",
        "layers",
        "patches",
        "raster",
        "looks",
        "extents",
        "annotations",
    ),
    *("placement", "scenes", "renderers", "drawing", "devices", "rollout", "fingerprint", "redraw", "pipeline"),
    *("generation", "streaming", "regeneration", "gallery", "space", "pictures"),
]
WITHOUT_JAX = ORDER[: ORDER.index("exporting") + 1]
PLUGINS = ("scenes", "renderers", "annotations", "exports")


def imports(path: Path) -> set[str]:
    """The gen2d modules that a file imports when it is imported itself (first part after `gen2d.`)."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "gen2d":
            parts = node.module.split(".")[1:]
            found |= {parts[0]} if parts else {alias.name for alias in node.names}
        if isinstance(node, ast.Import):
            found |= {a.name.split(".")[1] for a in node.names if a.name.startswith("gen2d.")}
    return found - {"__version__"}


@pytest.mark.parametrize(
    "path", [p for p in PACKAGE.rglob("*.py") if p.name != "__init__.py" or p.parent != PACKAGE], ids=str
)
def test_imports_point_down(path):
    name = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if name == "__main__":
        return
    allowed = set(ORDER[: ORDER.index(name)]) | (
        {name} if ((PACKAGE / name).is_dir() and name not in PLUGINS) or name == "exports" else set()
    )
    assert imports(path) <= allowed, f"{name} imports {imports(path) - allowed}"


@pytest.mark.parametrize("path", list((ROOT / "renderers").glob("*.py")), ids=lambda p: p.name)
def test_plugins_do_not_import_each_other(path):
    assert not imports(path) & {"renderers", "scenes", "generation", "rollout", "pipeline"}


def test_reading_data_never_imports_jax():
    names = ", ".join(f"gen2d.{name}" for name in WITHOUT_JAX)
    code = f"import gen2d, {names}, sys; gen2d.open, gen2d.DataLoader, gen2d.export, gen2d.verify; "
    code += "assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_data_folders_hold_no_code():
    for folder in ("datasets", "configs"):
        assert not list((ROOT / folder).rglob("*.py"))


def test_a_checkout_makes_only_the_two_folders_importable():
    if not (ROOT / "pyproject.toml").is_file():
        return  # installed from a wheel
    names = {m.name for m in pkgutil.iter_modules(gen2d.__path__)}
    assert not names & {"datasets", "tests", "gen2d", "renderers", "configs"}
    for name in ("datasets", "tests", "gen2d"):
        with pytest.raises(ModuleNotFoundError):
            importlib.import_module(f"gen2d.{name}")
    for name in ("renderers", "configs"):
        importlib.import_module(f"gen2d.{name}")


def test_public_names_stay_callable_after_their_modules_are_imported():
    for name in gen2d.__all__:
        assert callable(getattr(gen2d, name))
    importlib.import_module("gen2d.generation.run")
    importlib.import_module("gen2d.tools.verify")
    for name in gen2d.__all__:
        assert callable(getattr(gen2d, name)), name
