"""Configs whose numbers are parameters, and the structure that remains of a config without its numbers."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from gen2d.config.annotations import Annotations
from gen2d.config.config import Config
from gen2d.config.distributions import Distribution
from gen2d.config.joint_distribution import Component, JointDistribution
from gen2d.config.plugin_options import Plugin
from gen2d.config.sections import SimulationAnnotations, StorageOptions
from gen2d.config.splits import Split
from gen2d.records.layout import Layout
from gen2d.records.parameter import Tape

Number = Callable[[Any], Any]


def split_numbers(config: Config, layout: Layout | None = None) -> tuple[str, list[Any]]:
    """Structure of a config and a layout as text, equal for those that differ in numbers only, and these numbers."""
    numbers: list[Any] = []

    def take(number: Any) -> str:
        numbers.append(number)
        return f"{type(number).__name__} {len(numbers) - 1}"

    return repr((_replaced(config, take), _converted_layout(layout, take))), numbers


def parametrized(config: Config, tape: Tape, layout: Layout | None = None) -> tuple[Config, Any]:
    """Config and layout with a parameter of the tape in place of each number; leaf i is number i of `split_numbers`.

    It holds only what programs depend on.
    """
    count = iter(range(2**31))

    def parameter(number: Any) -> Any:
        return tape.leaf(next(count), number)

    return _replaced(config, parameter), _converted_layout(layout, parameter)


def only_sections(config: Config, *sections: str, simulated: bool = False, pixels: bool = False) -> Config:
    """The config of a program that depends on these sections alone; the others are None, empty or their defaults.

    `simulated` and `pixels` say whether it depends on annotations of the simulation or of pixels.
    """
    kept = {"name", "seed", "annotations", *sections}
    changes: dict[str, Any] = {f.name: None for f in dataclasses.fields(config) if f.name not in kept}
    changes |= {"splits": ()} if "splits" in changes else {}
    changes |= {"storage": StorageOptions()} if "storage" in changes else {}
    own = config.annotations
    annotations = Annotations(own.simulated if simulated else SimulationAnnotations(), own.pixels if pixels else ())
    return dataclasses.replace(config, annotations=annotations, **changes)


def _replaced(config: Config, convert: Number) -> Config:
    """The config with its numbers converted, and without its name, seed, licence and storage."""
    parts: dict[tuple[str, int], Distribution] = {}
    splits = tuple(Split(s.name, None, "{}", _converted_joint(s.distribution, convert, parts)) for s in config.splits)
    storage = StorageOptions(frames=config.storage.frames)
    static = {"name": "", "seed": 0, "licence": "", "storage": storage, "splits": splits}
    static |= {"annotations": config.annotations}
    names = [f.name for f in dataclasses.fields(config) if f.name not in static]
    return dataclasses.replace(config, **static, **{n: _converted(getattr(config, n), convert) for n in names})


def _converted_layout(layout: Layout | None, convert: Number) -> Any:
    """A layout with its lengths converted, also those that are whole numbers."""
    if layout is None:
        return None
    bounds = tuple(convert(float(x)) for x in layout.bounds)
    return dataclasses.replace(layout, bounds=bounds, reach=convert(float(layout.reach)))


def _converted_joint(
    joint: JointDistribution, convert: Number, parts: dict[tuple[str, int], Distribution]
) -> JointDistribution:
    """A joint distribution with its numbers converted.

    Distributions that are one object, such as those that splits inherit from the scene, remain one: `parts` holds those
    converted, by coordinate and object.
    """
    products = []
    for product in joint.products:
        for name, part in product.parts.items():
            if (name, id(part)) not in parts:
                parts[name, id(part)] = _converted(part, convert)
        own = {name: parts[name, id(part)] for name, part in product.parts.items()}
        products.append(Component(convert(product.share), own))
    return JointDistribution(tuple(products))


def _converted(value: Any, convert: Number, listed: bool = False) -> Any:
    """A tree of dataclasses, mappings and tuples with its numbers converted.

    A whole number by itself, such as a count, stays; those in tuples, such as a colour's, are converted.
    """
    if isinstance(value, float) or (listed and isinstance(value, int) and not isinstance(value, bool)):
        return convert(value)
    if isinstance(value, tuple):
        return tuple(_converted(part, convert, listed=True) for part in value)
    if isinstance(value, Mapping):
        return {key: _converted(part, convert) for key, part in value.items()}
    if isinstance(value, Distribution):
        kind = int if value.kind == "integer" else float
        numbers, parts = tuple(convert(kind(x)) for x in value.numbers), _converted(value.parts, convert)
        return dataclasses.replace(value, numbers=numbers, parts=parts)
    if isinstance(value, Plugin):
        return dataclasses.replace(value, options=_converted(value.options, convert), written_options=None)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return dataclasses.replace(value, **{name: _converted(part, convert) for name, part in parts.items()})
    return value
