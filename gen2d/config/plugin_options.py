"""A plug-in with its options, and the hash and content of a user's own file."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from gen2d.config import plugins
from gen2d.config.options import build, plain_of
from gen2d.core.errors import ConfigError
from gen2d.storage.sealed import sha256

Copies = Mapping[str, bytes]  # what files of the user's own held, by their names in the config
NO_COPIES: Copies = MappingProxyType({})


class StoredCopies(dict[str, bytes]):
    """Those that a dataset holds: its config names no other file, least of all one that lies here by chance."""


@dataclasses.dataclass(frozen=True)
class Plugin:
    """A named plug-in and its options. A scene's `options` can give whatever any split may draw."""

    name: str
    contract: Any  # Family, Look or Annotation
    options: Any
    sha256: str | None = None  # of a file of the user's own, which may change
    content: bytes = b""  # of that file
    own: Any = None  # the options as written, where splits draw others

    def plain(self) -> dict[str, Any]:
        """The plug-in as YAML and JSON hold it."""
        own = {"sha256": self.sha256} if self.sha256 else {}
        return {"name": self.name, **own, **plain_of(self.own or self.options)}


def named(values: Any) -> Any:
    """A plug-in as a mapping with its name; in a config its bare name is enough."""
    return {"name": values} if isinstance(values, str) else values


def plugin_of(kind: str, values: Any, default: str, source: str, copies: Copies) -> Plugin:
    """A plug-in with its options."""
    values = {} if values is None else named(values)
    if not isinstance(values, Mapping):
        raise ConfigError(f"{source}: {kind} is {values!r}, but must be a name, or a mapping with a name and options")
    name = values.get("name", default)
    if not isinstance(name, str):
        raise ConfigError(f"{source}: {kind}.name is {name!r}, but must be one of {', '.join(plugins.names(kind))}")
    contract, digest, content = contract_of(kind, name, values.get("sha256"), f"{source}: {kind}", copies)
    options = build(contract.options, {k: v for k, v in values.items() if k not in ("name", "sha256")}, kind, source)
    plugin = Plugin(name, contract, options, digest, content)
    check_plugin(plugin, kind, source)
    return plugin


def contract_of(kind: str, name: str, digest: Any, where: str, copies: Copies) -> tuple[Any, str | None, bytes]:
    """What a plug-in declares; of a file of the user's own also its sha256 and content, those of the copy with the
    sha256 `digest` if there is one. Raises ConfigError, which begins with `where`."""
    content, own = b"", None
    if plugins.is_own(name):
        content = copies.get(name, b"")
        if name not in copies or sha256(content) != digest:
            if isinstance(copies, StoredCopies):
                raise ConfigError(f"{where} is {name!r}, of which the dataset holds no copy that is what was written")
            content = plugins.content_of(name, where)
        own = sha256(content)
    if digest not in (None, own):
        raise ConfigError(f"{where}.sha256 is of another version of {name}")
    return plugins.load(kind, name, where, content), own, content


def check_plugin(plugin: Plugin, kind: str, source: str) -> None:
    """Raises ConfigError for options that the plug-in itself refuses."""
    try:
        plugin.contract.check(plugin.options)
    except ValueError as error:
        raise ConfigError(f"{source}: {kind}.{error}") from None
