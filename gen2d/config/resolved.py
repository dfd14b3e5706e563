"""The resolved config: every option with its value, also those that stored configs leave out at their defaults."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

from gen2d.config.config import DEFAULT_PLUGINS, SECTIONS, Config
from gen2d.config.options import Option, plain_value
from gen2d.config.reading import yaml_text
from gen2d.config.sections import SimulationAnnotations

Fields = Mapping[str, dataclasses.Field[Any]]


def resolved(config: Config) -> dict[str, Any]:
    """All options of a config with their values, as plain YAML and JSON values; reading them gives an equal config.

    Splits are as written: their options that are absent are those of the config.
    """
    plain = config.plain()
    for section, fields in _sections(config).items():
        plain[section] = _filled(plain[section], fields)
    for plugin in config.annotations.wanted:
        if dataclasses.is_dataclass(plugin.contract.options):
            fields = fields_of(plugin.contract.options)  # pyright: ignore[reportArgumentType]
            plain["annotations"][plugin.name] = _filled(plain["annotations"][plugin.name], fields)
    return plain


def resolved_text(config: Config, comments: bool = True) -> str:
    """The resolved config as YAML; comments give unit and meaning of each option."""
    plain, fields = resolved(config), _sections(config)
    return "".join(_lines(plain, fields)) if comments else yaml_text(plain)


def _lines(plain: Mapping[str, Any], fields: Mapping[str, Fields]) -> Iterator[str]:
    for section, values in plain.items():
        if section not in fields:
            yield yaml_text({section: values})
            continue
        yield f"{section}:\n"
        for name, value in values.items():
            field = fields[section].get(name)
            for line in _with_comment(yaml_text({name: value}), field.metadata["option"] if field else None):
                yield f"  {line}\n"


def _with_comment(text: str, spec: Option | None) -> list[str]:
    """Lines of one option, the first of which ends with a comment where YAML allows one."""
    first, *others = text.splitlines()
    if spec is None or (others and not first.endswith(":")):
        return [first, *others]
    unit = f"{spec.unit}; " if spec.unit not in ("", "1") else ""
    return [f"{first}  # {unit}{spec.meaning}", *others]


def _sections(config: Config) -> dict[str, Fields]:
    """Fields of the options of each section, by section and name."""
    plugs = {kind: fields_of(getattr(config, kind).contract.options) for kind in DEFAULT_PLUGINS}
    pixels = {
        plugin.name: plugin.contract.options
        for plugin in config.annotations.pixels
        if isinstance(plugin.contract.options, dataclasses.Field)
    }
    sections: dict[str, Fields] = {section: fields_of(options) for section, options in SECTIONS.items()}
    return {**sections, **plugs, "annotations": {**fields_of(SimulationAnnotations), **pixels}}


def fields_of(options: type) -> dict[str, dataclasses.Field[Any]]:
    """Fields of a class of options, by name."""
    return {field.name: field for field in dataclasses.fields(options)}


def _filled(values: Mapping[str, Any], fields: Fields) -> dict[str, Any]:
    """The values with the defaults of absent options, in the order of the fields; others first."""
    defaults = {name: plain_value(field.default) for name, field in fields.items()}
    first = {name: value for name, value in values.items() if name not in fields}
    rest = {name: values.get(name, default) for name, default in defaults.items()}
    return first | rest
