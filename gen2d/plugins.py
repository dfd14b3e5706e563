"""A name in a config is a file in a folder: find it, load it, or say which names there are."""

import difflib
import hashlib
import importlib
import importlib.util
import pathlib
import pkgutil
import sys
from types import ModuleType

from gen2d.errors import ConfigError

FOLDERS = {"scene": "gen2d.scenes", "look": "gen2d.renderers", "format": "gen2d.formats"}


def nearest(name: str, names: list[str]) -> str:
    """' Did you mean X?' or the names there are: the end of a sentence about an unknown name."""
    close = difflib.get_close_matches(str(name), names, n=1)
    return f"did you mean {close[0]}?" if close else "there are: " + ", ".join(sorted(names))


def names(kind: str) -> list[str]:
    """The names in the folder of a kind of plug-in."""
    return sorted(module.name for module in pkgutil.iter_modules(importlib.import_module(FOLDERS[kind]).__path__))


def load(kind: str, name: str, source: str = "--set") -> ModuleType:
    """The module behind a name, or behind the path of a Python file."""
    if name.endswith(".py"):
        return _load_path(kind, pathlib.Path(name).expanduser(), source)
    if name not in names(kind):
        raise ConfigError(f"{source}: {kind} is {name!r}, which is not known; {nearest(name, names(kind))}")
    return importlib.import_module(f"{FOLDERS[kind]}.{name}")


def sha256(name: str) -> str | None:
    """The hash of a plug-in that is a file of the user's own; None of one that comes with gen2d."""
    return hashlib.sha256(pathlib.Path(name).expanduser().read_bytes()).hexdigest() if name.endswith(".py") else None


def _load_path(kind: str, path: pathlib.Path, source: str) -> ModuleType:
    if not path.is_file():
        raise ConfigError(f"{source}: {kind} is {str(path)!r}, but there is no such file")
    spec = importlib.util.spec_from_file_location(f"gen2d_user_{kind}_{path.stem}", path)
    assert spec is not None  # a .py file always has a loader
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise ConfigError(f"{source}: {kind} is {str(path)!r}, which cannot be run ({error!r})") from error
    if not hasattr(module, "Options"):
        raise ConfigError(f"{source}: {kind} is {str(path)!r}, but it has no Options")
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
