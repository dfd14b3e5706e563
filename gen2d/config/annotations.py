"""The section `annotations`: options of the files in gen2d/annotations/, of the user's own, and of the simulation."""

import collections
import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Any

from gen2d.config import plugins
from gen2d.config.options import build, plain_of, plain_value, value_of
from gen2d.config.plugin_options import Copies, Plugin, contract_of
from gen2d.config.sections import SimulationAnnotations
from gen2d.core.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Annotations:
    """What is stored beside frames and states."""

    simulated: SimulationAnnotations
    pixels: tuple[Plugin, ...]  # their `options` are the single option's value, or the dataclass (None where it is off)

    @property
    def wanted(self) -> list[Plugin]:
        """Those of the pixels that are on."""
        return [plugin for plugin in self.pixels if plugin.options]

    @property
    def enabled(self) -> set[str]:
        """The names of all that is on."""
        simulated = {name for name, value in vars(self.simulated).items() if value}
        return simulated | {plugin.name for plugin in self.wanted}

    def plain(self) -> dict[str, Any]:
        """The section as YAML and JSON hold it."""
        return plain_of(self.simulated) | {plugin.name: _plain(plugin) for plugin in self.pixels}


def _plain(plugin: Plugin) -> Any:
    """`value` or `{option: value, ...}`; of a file of the user's own always a mapping, with its sha256."""
    single = not dataclasses.is_dataclass(plugin.contract.options)
    if single:
        value = plain_value(plugin.options)
        return {"sha256": plugin.sha256, "value": value} if plugin.sha256 else value
    own = {"sha256": plugin.sha256} if plugin.sha256 else {}
    return own | plain_of(plugin.options) if plugin.options else False


def annotations_of(values: Any, source: str, copies: Copies) -> Annotations:
    """The section that a mapping stands for. Raises ConfigError with one sentence that names `source`."""
    if not isinstance(values, Mapping):
        raise ConfigError(f"{source}: annotations is {values!r}, but must be a mapping of options")
    simulated = [field.name for field in dataclasses.fields(SimulationAnnotations)]
    files = plugins.names("annotation")
    own = [name for name, value in values.items() if _is_own(name) and value is not False]
    for name in values:
        if name not in (*simulated, *files) and not _is_own(name):
            raise ConfigError(
                f"{source}: annotations.{name} is not an option; {plugins.nearest(name, [*simulated, *files])}"
            )
    copied, count = (
        collections.Counter(pathlib.PurePath(name).name for name in own).most_common(1)[0] if own else ("", 0)
    )
    if count > 1:
        raise ConfigError(f"{source}: annotations has {count} files named {copied}: a dataset keeps a copy of one only")
    part = build(SimulationAnnotations, {k: v for k, v in values.items() if k in simulated}, "annotations", source)
    return Annotations(part, tuple(_annotation(name, values, source, copies) for name in (*files, *own)))


def _is_own(name: Any) -> bool:
    return isinstance(name, str) and plugins.is_own(name)


def _annotation(name: str, values: Mapping[str, Any], source: str, copies: Copies) -> Plugin:
    where, value = f"annotations.{name}", values.get(name, False)
    given = dict(value) if isinstance(value, Mapping) else {}
    digest = given.pop("sha256", None)
    contract, digest, content = contract_of("annotation", name, digest, f"{source}: an annotation", copies)
    if isinstance(contract.options, dataclasses.Field):
        spec, single = contract.options.metadata["option"], given["value"] if [*given] == ["value"] else value
        try:
            options = value_of(spec, single) if name in values else contract.options.default
        except ValueError as error:
            raise ConfigError(f"{source}: {where} is {value!r}, but must be {error}") from None
    elif isinstance(value, Mapping | bool):
        options = build(contract.options, given, where, source) if value is not False else None
    else:
        raise ConfigError(f"{source}: {where} is {value!r}, but must be true or false, or a mapping of options")
    return Plugin(name, contract, options, digest, content)
