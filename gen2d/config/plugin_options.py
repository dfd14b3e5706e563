"""Plug-ins with their options; for user files also the hash and content."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from gen2d.config import plugins
from gen2d.config.options import build, plain_of
from gen2d.core.errors import ConfigError
from gen2d.storage.sealed import sha256

Copies = Mapping[str, bytes]  # contents of user files, by their names in the config
NO_COPIES: Copies = MappingProxyType({})


class StoredCopies(dict[str, bytes]):
    """Copies stored in a dataset. Its config must use these only, never a file that happens to exist here."""


@dataclasses.dataclass(frozen=True)
class Plugin:
    """A named plug-in and its options. The supports of a scene's `options` contain those of all splits."""

    name: str
    contract: Any  # Family, Look or Annotation
    options: Any
    sha256: str | None = None  # of a user file, which may change
    content: bytes = b""  # of a user file
    written_options: Any = None  # the options as written, if the splits widen them

    def plain(self) -> dict[str, Any]:
        """The plug-in as plain YAML and JSON values."""
        digest = {"sha256": self.sha256} if self.sha256 else {}
        return {"name": self.name, **digest, **plain_of(self.written_options or self.options)}


def named(values: Any) -> Any:
    """A plug-in's mapping with its name; a bare name is expanded."""
    return {"name": values} if isinstance(values, str) else values


def plugin_of(kind: str, values: Any, default: str, source: str, copies: Copies) -> Plugin:
    """The plug-in of a config's section `kind`, from the section's value.

    Raises ConfigError, naming `source`, if the plug-in is unknown or its options are invalid.
    """
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
    """The contract of a plug-in and, for a user file, its sha256 and content.

    The content is that of the copy with the sha256 `digest`, if there is one, else that of the file itself. Raises
    ConfigError, beginning with `where`, if the file has another sha256 than `digest`, or if it is not a plug-in.
    """
    content, actual_digest = b"", None
    if plugins.is_user_file(name):
        copy = copies.get(name)
        if copy is not None and sha256(copy) == digest:
            content = copy
        elif isinstance(copies, StoredCopies):
            raise ConfigError(f"{where} is {name!r}, of which the dataset holds no copy that is what was written")
        else:
            content = plugins.content_of(name, where)
        actual_digest = sha256(content)
    if digest not in (None, actual_digest):
        raise ConfigError(f"{where}.sha256 is of another version of {name}")
    return plugins.load(kind, name, where, content), actual_digest, content


def check_plugin(plugin: Plugin, kind: str, source: str) -> None:
    """Raise ConfigError if the plug-in's own check rejects its options."""
    try:
        plugin.contract.check(plugin.options)
    except ValueError as error:
        raise ConfigError(f"{source}: {kind}.{error}") from None
