"""Public names that are imported on first use."""

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def attach(package: str, homes: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a module whose names live in others.

    `homes` maps a module to the names in it, separated by spaces; a name may be that of a submodule.
    """
    home = {name: module for module, names in homes.items() for name in names.split()}

    def get(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = importlib.import_module(home[name])
        return getattr(module, name) if hasattr(module, name) else importlib.import_module(f"{home[name]}.{name}")

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *home})

    return get, names
