"""What an option may be: its unit, default and range, said once where it is declared, and checked where it is read.

An error is one sentence with the file, the field, its value and what is allowed.
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
    """What an option may be. `parts` > 0: a list of so many values. `draw`: a distribution, else a single value; of a
    scene family a factor, `each` names what every one has a draw of its own for."""

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
    optional: bool = False  # may be null: decided by the program
    several: bool = False  # may be a list of such values

    @property
    def allowed(self) -> str:
        """What the option may be, for a sentence."""
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
    """A dataclass field that is an option; a drawn one's default is written as in a config."""
    spec = Option(kind, unit, meaning, **limits)
    if spec.draw and default is not None:
        default = [parse(v, kind is int) for v in default] if spec.parts else parse(default, kind is int)
    if isinstance(default, list):
        default = tuple(default)
    return dataclasses.field(default=default, metadata={"option": spec})


def plain_value(value: Any) -> Any:
    """An option's value as YAML and JSON hold it."""
    if isinstance(value, tuple):
        return [plain_value(part) for part in value]
    return value.plain() if isinstance(value, Distribution) else value


def plain_of(options: Any) -> dict[str, Any]:
    """Options as YAML and JSON hold them."""
    return {field.name: plain_value(getattr(options, field.name)) for field in dataclasses.fields(options)}


def _check(spec: Option, low: float, high: float) -> bool:
    return (
        (spec.low is None or low >= spec.low)
        and (spec.above is None or low > spec.above)
        and (spec.high is None or high <= spec.high)
    )


def _single(spec: Option, value: Any) -> Any:
    """A checked value, or ValueError with what is allowed."""
    if spec.draw:
        distribution = parse(value, spec.kind is int)
        if not _check(spec, *distribution.support):
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
    if (spec.kind is int and not float(value).is_integer()) or not _check(spec, value, value):
        raise ValueError(spec.allowed)
    return spec.kind(value)


def value_of(spec: Option, value: Any) -> Any:
    """A checked value, in a tuple if it has parts; ValueError with what is allowed."""
    if value is None and spec.optional:
        return None
    if spec.several:
        values = value if isinstance(value, list | tuple) and value else [value]
        return tuple(_single(spec, single) for single in values)
    if not spec.parts:
        return _single(spec, value)
    if not isinstance(value, list | tuple) or len(value) != spec.parts:
        raise ValueError(spec.allowed)
    return tuple(_single(spec, part) for part in value)


def build(cls: type, values: Any, where: str, source: str) -> Any:
    """An options dataclass from a mapping; `where` is the path of the mapping in the config."""
    if not isinstance(values, Mapping):
        raise ConfigError(f"{source}: {where} is {values!r}, but must be a mapping of options")
    known = {f.name: f.metadata["option"] for f in dataclasses.fields(cls)}
    filled = {}
    for key, value in values.items():
        if key not in known:
            raise ConfigError(f"{source}: {where}.{key} is not an option; {plugins.nearest(key, list(known))}")
        try:
            filled[key] = value_of(known[key], value)
        except ValueError as error:
            raise ConfigError(f"{source}: {where}.{key} is {value!r}, but must be {error}") from None
    return cls(**filled)


def coordinates(name: str, value: Any) -> dict[str, Any]:
    """The single numbers that an option's value is made of, by name: `radius`, or `velocity[0]` and `velocity[1]`."""
    return {f"{name}[{i}]": part for i, part in enumerate(value)} if isinstance(value, tuple) else {name: value}


def drawn_options(family: Family) -> dict[str, Option]:
    """The option behind each factor of a family, by name."""
    specs = {field.name: field.metadata["option"] for field in dataclasses.fields(family.options)}
    return {name: spec for name, spec in specs.items() if spec.draw}
