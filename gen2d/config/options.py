"""Options: unit, default and range, declared once with the option and checked when a config is read.

Each error is one sentence that names the file, the field, its value and the values allowed.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

from gen2d.config import plugins
from gen2d.config.contracts import Family
from gen2d.config.distribution_syntax import is_number, parse
from gen2d.config.distributions import Distribution
from gen2d.core.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Option:
    """Type, unit and range of an option.

    draw: the value is a distribution, not a single number; such an option of a scene family is a factor.
    parts: length of a list of values; 0 for a single value.
    each: plural name of the objects for each of which a factor is sampled separately; "" for once per video.
    """

    kind: type  # int, float, str or bool
    unit: str
    meaning: str
    low: float | None = None
    high: float | None = None
    above: float | None = None
    choices: tuple[str, ...] = ()
    draw: bool = False
    parts: int = 0
    each: str = ""
    optional: bool = False  # may be null: gen2d decides
    several: bool = False  # may also be a list of values
    later: bool = False  # younger than stored configs, which lack it: plain values have it only where it is changed

    @property
    def allowed(self) -> str:
        """Description of the values allowed, for error messages and help."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if self.kind is bool:
            return "true or false"
        noun = {int: "whole number", float: "number", str: "text"}[self.kind]
        ends = [
            f"above {self.above:g}" if self.above is not None else "",
            f"{self.low:g} or more" if self.low is not None else "",
        ]
        ends.append(f"{self.high:g} or less" if self.high is not None else "")
        limits = " and ".join(end for end in ends if end)
        text = f"a {noun}" if not self.parts else f"a list of {self.parts} {noun}s"
        text += f" or a list of {noun}s" if self.several else ""
        return text + (f", {limits}" if limits else "") + (" (or null)" if self.optional else "")


def option(default: Any, kind: type, unit: str, meaning: str, **limits: Any) -> Any:
    """A dataclass field that declares an option. With `draw=True` the default is written as in a config."""
    spec = Option(kind, unit, meaning, **limits)
    if spec.draw and default is not None:
        default = [parse(v, kind is int) for v in default] if spec.parts else parse(default, kind is int)
    if isinstance(default, list):
        default = tuple(default)
    return dataclasses.field(default=default, metadata={"option": spec})


def plain_value(value: Any) -> Any:
    """An option's value as a plain YAML and JSON value."""
    if isinstance(value, tuple):
        return [plain_value(part) for part in value]
    return value.plain() if isinstance(value, Distribution) else value


def plain_of(options: Any) -> dict[str, Any]:
    """Options as plain YAML and JSON values, by name; a later option is left out at its default."""
    plain = {}
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if not field.metadata["option"].later or value != field.default:
            plain[field.name] = plain_value(value)
    return plain


def _in_range(spec: Option, low: float, high: float) -> bool:
    return (
        (spec.low is None or low >= spec.low)
        and (spec.above is None or low > spec.above)
        and (spec.high is None or high <= spec.high)
    )


def _parse_single(spec: Option, value: Any) -> Any:
    """The checked value. Raises ValueError, whose message is the values allowed."""
    if spec.draw:
        distribution = parse(value, spec.kind is int)
        if not _in_range(spec, *distribution.support):
            raise ValueError(spec.allowed + (" for every value drawn" if distribution.kind != "constant" else ""))
        return distribution
    if spec.kind is str:
        if not isinstance(value, str) or (spec.choices and value not in spec.choices):
            raise ValueError(spec.allowed)
        return value
    if spec.kind is bool and isinstance(value, bool):
        return value
    if not is_number(value) or spec.kind is bool:
        raise ValueError(spec.allowed)
    if (spec.kind is int and not float(value).is_integer()) or not _in_range(spec, value, value):
        raise ValueError(spec.allowed)
    return spec.kind(value)


def parse_value(spec: Option, value: Any) -> Any:
    """The checked value of an option; a tuple if the option has several values or parts.

    Raises ValueError, whose message is the values allowed.
    """
    if value is None and spec.optional:
        return None
    if spec.several:
        values = value if isinstance(value, list | tuple) and value else [value]
        return tuple(_parse_single(spec, single) for single in values)
    if not spec.parts:
        return _parse_single(spec, value)
    if not isinstance(value, list | tuple) or len(value) != spec.parts:
        raise ValueError(spec.allowed)
    return tuple(_parse_single(spec, part) for part in value)


def build(cls: type, values: Any, where: str, source: str) -> Any:
    """An instance of an options dataclass, from a mapping at the path `where` of the config.

    Raises ConfigError, naming `source` and the option, if an option is unknown or its value not allowed.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{source}: {where} is {values!r}, but must be a mapping of options")
    known = {f.name: f.metadata["option"] for f in dataclasses.fields(cls)}
    defaults = {f.name: plain_value(f.default) for f in dataclasses.fields(cls)}
    filled = {}
    for key, value in values.items():
        if key not in known:
            raise ConfigError(f"{source}: {where}.{key} is not an option; {plugins.nearest(key, list(known))}")
        try:
            filled[key] = parse_value(known[key], value)
        except ValueError as error:
            usual = defaults[key] if known[key].parts and not isinstance(value, list) else None
            is_short = isinstance(usual, list) and all(isinstance(part, int | float) for part in usual)
            example = f", such as {usual}" if is_short else ""
            raise ConfigError(f"{source}: {where}.{key} is {value!r}, but must be {error}{example}") from None
    return cls(**filled)


def drawn_options(options: Any) -> dict[str, Option]:
    """Options of a dataclass, or of an instance of it, that are sampled for each video, by name."""
    specs = {field.name: field.metadata["option"] for field in dataclasses.fields(options)}
    return {name: spec for name, spec in specs.items() if spec.draw}


def coordinates(name: str, value: Any) -> dict[str, Any]:
    """The scalar components of an option's value, by name: `radius`, or `velocity[0]` and `velocity[1]`."""
    return {f"{name}[{i}]": part for i, part in enumerate(value)} if isinstance(value, tuple) else {name: value}


def factor_options(family: Family) -> dict[str, Option]:
    """Options of a family that are factors, by name."""
    return drawn_options(family.options)
