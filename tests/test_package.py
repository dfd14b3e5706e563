"""How the project is put together: imports point down, the checkout and the wheel hold the same, data stays data."""

import ast
import importlib
import importlib.metadata
import inspect
import pkgutil
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

import gen2d

ROOT = Path(gen2d.__file__).parent.parent
PACKAGE = ROOT / "gen2d"
RENDERERS = Path(next(iter(importlib.import_module("gen2d.renderers").__path__)))
# Each room imports only the rooms above it, inside functions too; rooms of one line know nothing of each other.
LAYERS = (
    ("core",),
    ("records", "xla", "storage"),
    ("config", "dataset", "media"),
    ("renderers", "physics", "loading"),
    ("sampling", "annotations", "captions", "page", "grain", "torch"),
    ("scenes",),
    ("programs", "engines"),
    ("space",),
    ("generation",),
    ("tools", "exports"),
    ("cli",),
)
RANKS = {room: rank for rank, layer in enumerate(LAYERS) for room in layer}
# Imports inside functions that go up, so that frames that are not stored are rendered where they are asked for.
UPWARD = {("gen2d.loading.dataset", "gen2d.programs.rendered_dataset")}
# None of these imports jax when it is imported.
WITHOUT_JAX = ("core", "storage", "dataset", "media", "loading", "captions", "page", "exports", "tools.verify", "cli")


def sources() -> dict[str, Path]:
    """Every module of gen2d and its file."""
    found = {}
    for root, prefix in ((PACKAGE, "gen2d"), (RENDERERS, "gen2d.renderers")):
        for path in root.rglob("*.py"):
            parts = path.relative_to(root).with_suffix("").parts
            if root == PACKAGE and parts[0] in ("renderers", "configs"):
                continue
            found[".".join((prefix, *parts)).removesuffix(".__init__")] = path
    return found


MODULES = sources()


def imports(path: Path) -> set[str]:
    """The modules of gen2d that a file imports, anywhere in it, but for those that it may import from above."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "gen2d":
            names = (f"{node.module}.{alias.name}" for alias in node.names)
            found |= {name if name in MODULES else node.module for name in names}
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.startswith("gen2d.")}
    own = {name for name, file in MODULES.items() if file == path}
    return found - {"gen2d", "gen2d._version"} - {above for below, above in UPWARD if below in own}


def room_of(module: str) -> str:
    return module.split(".")[1]


PLUGINS = ("gen2d.scenes.", "gen2d.renderers.looks.", "gen2d.annotations.", "gen2d.exports.formats.")
FACADES = ("gen2d", "gen2d.__main__", "gen2d._version", "gen2d.plugin")  # names from all rooms


@pytest.mark.parametrize("module", [name for name in MODULES if name not in FACADES])
def test_imports_point_down(module: str) -> None:
    own, needed = room_of(module), imports(MODULES[module])
    if module.startswith(PLUGINS):
        assert needed <= {"gen2d.plugin"}
    else:
        assert not {name for name in needed if room_of(name) != own and RANKS.get(room_of(name), 99) >= RANKS[own]}


def test_no_imports_go_in_a_circle() -> None:
    graph = {name: imports(path) & MODULES.keys() for name, path in MODULES.items()}
    while leaves := [name for name, needed in graph.items() if not needed & graph.keys()]:
        for name in leaves:
            del graph[name]
    assert not graph


def definitions(tree: ast.Module) -> set[str]:
    """The classes and aliases of types of a module."""
    found = {node.name for node in tree.body if isinstance(node, ast.ClassDef)}
    for node in tree.body:
        if isinstance(node, ast.Assign):
            names = {target.id for target in node.targets if isinstance(target, ast.Name)}
            found |= {name for name in names if name[0].isupper() and not name.isupper()}
    return found


# Containers of a whole process, and the constants that bound them.
CONTAINERS = {
    "gen2d.loading.chunks._files": "OPEN_FILES",
    "gen2d.programs.shared._programs": "MAX_PROGRAMS",
    "gen2d.storage.image_folder._files": "MAX_NAMED",
}


def unbounded_caches(tree: ast.Module) -> list[str]:
    """Functions with parameters whose results are all kept."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            calls = [ast.unparse(decorator).removeprefix("functools.") for decorator in node.decorator_list]
            has_parameters = any((node.args.args, node.args.vararg, node.args.kwonlyargs, node.args.kwarg))
            if has_parameters and {"cache", "cache()", "lru_cache(maxsize=None)", "lru_cache(None)"} & {*calls}:
                found.append(node.name)
    return found


def containers(tree: ast.Module) -> set[str]:
    """Empty containers of the module, which its functions fill."""
    empty = {"{}", "[]", "dict()", "list()", "set()", "OrderedDict()", "deque()", "Counter()", "defaultdict(list)"}
    found = set()
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None and ast.unparse(node.value) in empty:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {target.id for target in targets if isinstance(target, ast.Name)}
    return found


def test_no_cache_grows_without_bound() -> None:
    trees = {name: ast.parse(path.read_text()) for name, path in MODULES.items()}
    assert {name: caches for name, tree in trees.items() if (caches := unbounded_caches(tree))} == {}
    assert {f"{name}.{container}" for name, tree in trees.items() for container in containers(tree)} == {*CONTAINERS}
    for container, bound in CONTAINERS.items():
        module, _, name = container.rpartition(".")
        assert f"while len({name}) > {bound}:" in MODULES[module].read_text()
    example = ast.parse("@functools.cache\ndef f(x): ...\n@cache\ndef g(): ...\nkept: dict[str, int] = {}\nnames = 3")
    assert (unbounded_caches(example), containers(example)) == (["f"], {"kept"})


def test_a_class_has_one_name_and_a_name_one_class() -> None:
    owners: dict[str, list[str]] = {}
    for module, path in MODULES.items():
        for name in definitions(ast.parse(path.read_text())) - {"Options"}:  # every plug-in has its own
            owners.setdefault(name, []).append(module)
    assert {name: modules for name, modules in owners.items() if len(modules) > 1} == {}


def test_names_are_nouns_of_the_field() -> None:
    poetry = {"told", "found", "made", "settled", "spots", "posts", "seats", "books"}
    for module, path in MODULES.items():
        assert module.rpartition(".")[2] not in poetry
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                assert node.name.strip("_").lower() not in poetry, f"{module}.{node.name}"


@pytest.mark.parametrize("facade", ["gen2d", "gen2d.plugin"])
def test_public_names_are_declared_alike(facade: str) -> None:
    module = importlib.import_module(facade)
    tree = ast.parse(MODULES[facade].read_text())
    typed = next(node for node in tree.body if isinstance(node, ast.If))
    declared = {
        (node.module, alias.name) for node in typed.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert declared == {(home, name) for home, names in module._HOMES.items() for name in names.split()}
    assert sorted(module.__all__) == sorted(name for _, name in declared)
    assert set(module.__all__) <= set(dir(module))
    assert all(getattr(module, name) is not None for name in module.__all__)
    with pytest.raises(AttributeError, match=f"module '{facade}' has no attribute 'nothing'"):
        _ = module.nothing


def public() -> dict[str, Callable]:
    """Every public function, and the public methods of public classes."""
    functions = {}
    for name in gen2d.__all__:
        value = getattr(gen2d, name)
        members = vars(value) if inspect.isclass(value) else {"": value}
        methods = {member: function for member, function in members.items() if inspect.isfunction(function)}
        functions |= {f"{name}.{member}".strip("."): f for member, f in methods.items() if not member.startswith("_")}
    return functions


PUBLIC = public()
JSON = {"Config.plain", "Config.recipe"}  # whose values are those of JSON


@pytest.mark.parametrize("name", PUBLIC)
def test_a_public_function_names_its_parameters_and_their_types(name: str) -> None:
    signature = inspect.signature(PUBLIC[name])
    doc = PUBLIC[name].__doc__ or ""
    assert doc.strip()
    ours = [p for p in signature.parameters if p not in ("self", "options")]
    assert [p for p in ours if len(ours) > 1 and not re.search(rf"\b{p}\b", doc)] == []
    annotations = inspect.get_annotations(PUBLIC[name])
    assert annotations.keys() >= {*signature.parameters.keys() - {"self"}, "return"}
    assert name in JSON or not any(re.search(r"\bAny\b", f"{annotation}") for annotation in annotations.values())


def test_few_files_lie_beside_the_rooms() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= 10


def test_reading_data_never_imports_jax() -> None:
    names = [name for name in MODULES if name.removeprefix("gen2d.").startswith(WITHOUT_JAX)] + ["gen2d.plugin"]
    assert len(names) > 50
    code = f"import gen2d, {', '.join(names)}, sys; gen2d.open, gen2d.DataLoader, gen2d.export, gen2d.verify; "
    code += "assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_plain_installation_is_what_the_main_job_imports() -> None:
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    names = {re.split(r"[^\w.-]", each)[0].lower() for each in project["dependencies"]}
    assert names == {"h5py", "isal", "jax", "numpy", "pillow", "ruamel.yaml", "scipy", "tqdm"}
    extras = ("av", "chex", "cv2", "fsspec", "hdf5plugin", "matplotlib", "pyarrow", "ray", "torch", "zstandard")
    code = f"import sys; sys.modules.update(dict.fromkeys({extras})); from gen2d.cli import main; "
    code += "import gen2d.generation.run, gen2d.generation.regenerate, gen2d.tools.preview, gen2d.tools.gallery"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_plain_installation_is_mostly_jax() -> None:
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    sizes, todo = dict[str, int](), list(project["dependencies"])
    while todo:
        requirement = todo.pop()
        name = re.split(r"[^\w.-]", requirement)[0].lower()
        if "extra ==" in requirement or name in sizes:
            continue
        try:
            distribution = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:  # for another Python or system
            continue
        sizes[name] = sum(file.size or 0 for file in distribution.files or ())
        todo += distribution.requires or []
    largest = sum(sizes[name] for name in ("jax", "jaxlib", "numpy", "scipy"))
    assert largest > 400 * 2**20
    assert sum(sizes.values()) - largest < 70 * 2**20
    assert sum(sizes.values()) < 670 * 2**20


def test_data_folders_hold_no_code():
    for folder in ("datasets", "configs"):
        assert not list((ROOT / folder).rglob("*.py"))


def test_a_checkout_makes_only_the_two_folders_importable():
    if not (ROOT / "pyproject.toml").is_file():
        return  # installed from a wheel
    names = {m.name for m in pkgutil.iter_modules(gen2d.__path__)}
    assert not names & {"datasets", "tests", "gen2d"}
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


def test_a_citation_names_this_version():
    citation = (Path(__file__).parent.parent / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {gen2d.__version__}\n" in citation
