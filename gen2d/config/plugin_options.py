"""A plug-in with its options, and the hash and content of a user's own file."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType, ModuleType
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
    module: ModuleType
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
    content, digest = _content(kind, name, values, source, copies) if plugins.is_own(name) else (b"", None)
    if values.get("sha256", digest) != digest:
        raise ConfigError(f"{source}: {kind}.sha256 is of another version of {name}")
    module = plugins.load(kind, name, source, content)
    options = build(module.Options, {k: v for k, v in values.items() if k not in ("name", "sha256")}, kind, source)
    plugin = Plugin(name, module, options, digest, content)
    check_plugin(plugin, kind, source)
    return plugin


def _content(kind: str, name: str, values: Mapping, source: str, copies: Copies) -> tuple[bytes, str]:
    """What a file of the user's own holds, and its sha256: of the copy if that is the version asked for."""
    if name in copies and sha256(copies[name]) == values.get("sha256"):
        return copies[name], values["sha256"]
    if isinstance(copies, StoredCopies):
        raise ConfigError(f"{source}: {kind} is {name!r}, of which the dataset holds no copy that is what was written")
    content = plugins.content_of(kind, name, source)
    return content, sha256(content)


def check_plugin(plugin: Plugin, kind: str, source: str) -> None:
    """Returns nothing; raises ConfigError for options that the plug-in itself refuses."""
    if hasattr(plugin.module, "check"):
        try:
            plugin.module.check(plugin.options)
        except ValueError as error:
            raise ConfigError(f"{source}: {kind}.{error}") from None
