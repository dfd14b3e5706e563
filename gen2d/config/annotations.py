"""The section `annotations`: options of the plug-ins in gen2d/annotations/, of user files, and of the simulation."""

import collections
import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Any

from gen2d.config import plugins
from gen2d.config.options import build, parse_value, plain_of, plain_value
from gen2d.config.plugin_options import Copies, Plugin, contract_of
from gen2d.config.sections import SimulationAnnotations
from gen2d.core.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Annotations:
    """Annotations that a dataset stores beside frames and states."""

    simulated: SimulationAnnotations
    pixels: tuple[Plugin, ...]  # `options`: a single value, or a dataclass (None if off)

    @property
    def wanted(self) -> list[Plugin]:
        """Pixel annotations that are switched on."""
        return [plugin for plugin in self.pixels if plugin.options]

    @property
    def enabled(self) -> set[str]:
        """Names of all annotations that are switched on."""
        simulated = {name for name, value in vars(self.simulated).items() if value}
        return simulated | {plugin.name for plugin in self.wanted}

    def plain(self) -> dict[str, Any]:
        """The section as plain YAML and JSON values."""
        written = [plugin for plugin in self.pixels if plugin.options or not _is_later(plugin)]
        return plain_of(self.simulated) | {plugin.name: _plain_value(plugin) for plugin in written}


def _is_later(plugin: Plugin) -> bool:
    """Whether stored configs may lack the annotation: a single option that is younger than they are."""
    options = plugin.contract.options
    return isinstance(options, dataclasses.Field) and options.metadata["option"].later


def _plain_value(plugin: Plugin) -> Any:
    """`value` or `{option: value, ...}`; always a mapping for a user file, which adds its sha256."""
    digest = {"sha256": plugin.sha256} if plugin.sha256 else {}
    if dataclasses.is_dataclass(plugin.contract.options):
        return digest | plain_of(plugin.options) if plugin.options else False
    value = plain_value(plugin.options)
    return digest | {"value": value} if digest else value


def parse_annotations(values: Any, source: str, copies: Copies) -> Annotations:
    """The section `annotations` of a config, from its mapping.

    `copies` holds user files that the dataset stores. Raises ConfigError, naming `source`, if an option is unknown or
    out of range, or if two user files share a file name.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{source}: annotations is {values!r}, but must be a mapping of options")
    simulated = [field.name for field in dataclasses.fields(SimulationAnnotations)]
    built_in = plugins.names("annotation")
    user_files = [name for name, value in values.items() if plugins.is_user_file(name) and value is not False]
    for name in values:
        if name not in (*simulated, *built_in) and not plugins.is_user_file(name):
            raise ConfigError(
                f"{source}: annotations.{name} is not an option; {plugins.nearest(name, [*simulated, *built_in])}"
            )
    for filename, count in collections.Counter(pathlib.PurePath(name).name for name in user_files).most_common(1):
        if count > 1:
            raise ConfigError(
                f"{source}: annotations has {count} files named {filename}: a dataset keeps a copy of one only"
            )
    simulation = build(
        SimulationAnnotations, {k: v for k, v in values.items() if k in simulated}, "annotations", source
    )
    return Annotations(
        simulation, tuple(_parse_annotation(name, values, source, copies) for name in (*built_in, *user_files))
    )


def _parse_annotation(name: str, values: Mapping[str, Any], source: str, copies: Copies) -> Plugin:
    where, value = f"annotations.{name}", values.get(name, False)
    given = dict(value) if isinstance(value, Mapping) else {}
    digest = given.pop("sha256", None)
    contract, digest, content = contract_of("annotation", name, digest, f"{source}: an annotation", copies)
    if isinstance(contract.options, dataclasses.Field):
        spec = contract.options.metadata["option"]
        single_value = given["value"] if [*given] == ["value"] else value
        try:
            options = parse_value(spec, single_value) if name in values else contract.options.default
        except ValueError as error:
            raise ConfigError(f"{source}: {where} is {value!r}, but must be {error}") from None
    elif isinstance(value, Mapping | bool):
        options = build(contract.options, given, where, source) if value is not False else None
    else:
        raise ConfigError(f"{source}: {where} is {value!r}, but must be true or false, or a mapping of options")
    return Plugin(name, contract, options, digest, content)
