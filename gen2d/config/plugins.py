"""A name in a config is a file in a folder, or the path of one: find it, load it, or say which names there are."""

import difflib
import functools
import importlib
import pathlib
import pkgutil
import sys
from types import ModuleType
from typing import Any

from gen2d.config.contracts import Annotation, Export, Family, Look
from gen2d.core.errors import ConfigError

# The folder of each kind of plug-in and the type of the constant that a file ends with: FAMILY = Family(...).
KINDS = {
    "scene": ("gen2d.scenes", Family),
    "look": ("gen2d.renderers.looks", Look),
    "annotation": ("gen2d.annotations", Annotation),
    "export": ("gen2d.exports.formats", Export),
}


def nearest(name: str, names: list[str]) -> str:
    """' Did you mean X?' or the names there are: the end of a sentence about an unknown name."""
    close = difflib.get_close_matches(str(name), names, n=1)
    return f"did you mean {close[0]}?" if close else "there are: " + ", ".join(sorted(names))


def names(kind: str) -> list[str]:
    """The names in the folder of a kind of plug-in."""
    return sorted(module.name for module in pkgutil.iter_modules(importlib.import_module(KINDS[kind][0]).__path__))


def load(kind: str, name: str, where: str = "--set", content: bytes = b"") -> Any:
    """The contract that a name's file declares, or the Python file of the user's own at a path, which holds `content`.

    Raises ConfigError, which begins with `where`, for an unknown name and for a file that cannot be run or declares
    nothing.
    """
    if not is_own(name) and name not in names(kind):
        raise ConfigError(f"{where} is {name!r}, which is not known; {nearest(name, names(kind))}")
    try:
        module = _run(kind, pathlib.Path(name).expanduser(), content) if is_own(name) else _module(kind, name)
    except Exception as error:
        raise ConfigError(f"{where} is {name!r}, which cannot be run ({error!r})") from error
    contract = KINDS[kind][1]
    constant = contract.__name__.upper()
    declared = vars(module).get(constant)
    if not isinstance(declared, contract):
        own = (
            f"its {constant} is of type {type(declared).__name__}" if constant in vars(module) else f"has no {constant}"
        )
        raise ConfigError(f"{where} is {name!r}, but {own}: it must end with {constant} = {contract.__name__}(...)")
    return declared


def summary(kind: str, name: str) -> str:
    """The first line of the docstring of a file in a kind's folder."""
    return (_module(kind, name).__doc__ or "").strip().partition("\n")[0]


def _module(kind: str, name: str) -> ModuleType:
    return importlib.import_module(f"{KINDS[kind][0]}.{name}")


def is_own(name: str) -> bool:
    """Whether it is the path of a file of the user's own."""
    return name.endswith(".py")


def copy_name(kind: str, name: str) -> str:
    """Where in a dataset's folder the copy of a file of the user's own lies."""
    return f"plugins/{kind}/{pathlib.PurePath(name).name}"


def content_of(name: str, where: str) -> bytes:
    """The content of a file of the user's own. Raises ConfigError, which begins with `where`."""
    path = pathlib.Path(name).expanduser()
    try:
        return path.read_bytes()
    except OSError as error:
        told = "there is no such file" if isinstance(error, FileNotFoundError) else "it cannot be read"
        raise ConfigError(f"{where} is {str(path)!r}, but {told}") from None


@functools.lru_cache(maxsize=64)  # the same module each time, so that what was compiled for it is found again
def _run(kind: str, path: pathlib.Path, content: bytes) -> ModuleType:
    """The module that the content is, as if it stood at the path: of a copy, where it was copied from."""
    module = ModuleType(f"gen2d_user_{kind}_{path.stem}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses look their module up
    exec(compile(content, path, "exec"), vars(module))
    return module


def config_folder() -> pathlib.Path:
    """Where the configs that come with gen2d lie."""
    return pathlib.Path(next(iter(importlib.import_module("gen2d.configs").__path__)))


def config_names() -> list[str]:
    """The configs that come with gen2d."""
    return sorted(path.name for path in config_folder().glob("*.yaml"))


def find_config(name: str) -> pathlib.Path:
    """A YAML file by its path or, failing that, by its name among those that come with gen2d."""
    path = pathlib.Path(name).expanduser()
    if path.is_file():
        return path
    if name and path.is_dir():
        raise ConfigError(f"--config is {name!r}, which is a folder; name a YAML file")
    for candidate in (path.name, f"{path.name}.yaml"):
        if path.parent == pathlib.Path() and (config_folder() / candidate).is_file():
            return config_folder() / candidate
    raise ConfigError(f"--config is {name!r}, but there is no such file; {nearest(path.name, config_names())}")
