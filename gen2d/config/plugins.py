"""Plug-ins and configs by name or path: finding, loading and listing them."""

import ast
import difflib
import functools
import importlib
import importlib.util
import pathlib
import pkgutil
import sys
from types import ModuleType
from typing import Any, TypeGuard

from gen2d.config.contracts import Annotation, Export, Family, Look
from gen2d.core.errors import ConfigError, argument

# For each kind of plug-in, its package and the type of the constant that declares it, such as FAMILY = Family(...).
KINDS = {
    "scene": ("gen2d.scenes", Family),
    "look": ("gen2d.renderers.looks", Look),
    "annotation": ("gen2d.annotations", Annotation),
    "export": ("gen2d.exports.formats", Export),
}


def nearest(name: str, names: list[str]) -> str:
    """'did you mean X?', or the list of known names: the end of an error about an unknown name."""
    close = difflib.get_close_matches(str(name), names, n=1)
    return f"did you mean {close[0]}?" if close else "there are: " + ", ".join(sorted(names))


@functools.lru_cache(maxsize=8)  # of the few kinds; the folders do not change
def names(kind: str) -> list[str]:
    """Sorted names of the built-in plug-ins of a kind."""
    return sorted(module.name for module in pkgutil.iter_modules(_folders(kind)))


def _folders(kind: str) -> list[str]:
    """Folders of the built-in plug-ins of a kind; their package is not imported, as it may import jax."""
    spec = importlib.util.find_spec(KINDS[kind][0])
    return [*((spec and spec.submodule_search_locations) or ())]


def load(kind: str, name: str, where: str = "", content: bytes = b"") -> Any:
    """The contract declared by a built-in plug-in, or by the user file with this path and `content`.

    Raises ConfigError, beginning with `where`, if the name is unknown, or if the file fails to run or does not declare
    a contract of this kind.
    """
    where = where or argument("set")
    if not is_user_file(name) and name not in names(kind):
        raise ConfigError(f"{where} is {name!r}, which is not known; {nearest(name, names(kind))}")
    try:
        module = (
            _run_file(kind, pathlib.Path(name).expanduser(), content) if is_user_file(name) else _module(kind, name)
        )
    except Exception as error:
        raise ConfigError(f"{where} is {name!r}, which cannot be run ({error!r})") from error
    contract = KINDS[kind][1]
    constant = contract.__name__.upper()
    declared = vars(module).get(constant)
    if not isinstance(declared, contract):
        problem = (
            f"its {constant} is of type {type(declared).__name__}" if constant in vars(module) else f"has no {constant}"
        )
        raise ConfigError(f"{where} is {name!r}, but {problem}: it must end with {constant} = {contract.__name__}(...)")
    return declared


def summary(kind: str, name: str) -> str:
    """First line of a built-in plug-in's docstring."""
    return (_module(kind, name).__doc__ or "").strip().partition("\n")[0]


def written_summary(kind: str, name: str) -> str:
    """The `summary` of a built-in plug-in, read from its file without importing it."""
    for folder in _folders(kind):
        path = pathlib.Path(folder) / f"{name}.py"
        if path.is_file():
            return (ast.get_docstring(ast.parse(path.read_bytes())) or "").partition("\n")[0]
    return ""


def _module(kind: str, name: str) -> ModuleType:
    return importlib.import_module(f"{KINDS[kind][0]}.{name}")


def is_user_file(name: Any) -> TypeGuard[str]:
    """Whether a plug-in's name is the path of a user file."""
    return isinstance(name, str) and name.endswith(".py")


def copy_name(kind: str, name: str) -> str:
    """Path of the copy of a user file, relative to the dataset's folder."""
    return f"plugins/{kind}/{pathlib.PurePath(name).name}"


def content_of(name: str, where: str) -> bytes:
    """The content of a user file. Raises ConfigError, beginning with `where`, if it cannot be read."""
    path = pathlib.Path(name).expanduser()
    try:
        return path.read_bytes()
    except OSError as error:
        problem = "there is no such file" if isinstance(error, FileNotFoundError) else "it cannot be read"
        raise ConfigError(f"{where} is {str(path)!r}, but {problem}") from None


@functools.lru_cache(maxsize=64)  # one module per content, so that jax finds its compiled programs again
def _run_file(kind: str, path: pathlib.Path, content: bytes) -> ModuleType:
    """The module of a user file's content, with `path` as its file; for a copy, the path of the original."""
    module = ModuleType(f"gen2d_user_{kind}_{path.stem}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses look up their module here
    exec(compile(content, path, "exec"), vars(module))
    return module


def config_folder() -> pathlib.Path:
    """Folder of the configs that come with gen2d."""
    return pathlib.Path(next(iter(importlib.import_module("gen2d.configs").__path__)))


def config_names() -> list[str]:
    """Sorted file names of the configs that come with gen2d."""
    return sorted(path.name for path in config_folder().glob("*.yaml"))


def find_config(name: str) -> pathlib.Path:
    """Path of a YAML file, given by that path or by the name of a config that comes with gen2d.

    A folder of that name in the working directory does not hide the config.

    Raises ConfigError if there is no such file.
    """
    path = pathlib.Path(name).expanduser()
    if path.is_file():
        return path
    for candidate in (path.name, f"{path.name}.yaml"):
        if path.parent == pathlib.Path() and (config_folder() / candidate).is_file():
            return config_folder() / candidate
    if name and path.is_dir():
        raise ConfigError(f"the config is {name!r}, which is a folder; name a YAML file")
    raise ConfigError(f"the config is {name!r}, but there is no such file; {nearest(path.name, config_names())}")
