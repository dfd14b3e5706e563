"""A JSON Schema (draft 2020-12) of configs, from the options that sections and plug-ins declare.

An editor completes and checks a config with it. It accepts every config that gen2d reads, and refuses unknown names,
wrong types and numbers out of range; what depends on several values at once, such as the order of a range's ends or
whether splits are disjoint, only reading the config checks.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

from gen2d.config import plugins
from gen2d.config.config import DEFAULT_PLUGINS, MAX_LICENCE, MAX_SEED, SECTIONS
from gen2d.config.distribution_syntax import MAX_MAGNITUDE, MAX_NUMBERS, MAX_PARTS
from gen2d.config.options import Option, factor_options, plain_value
from gen2d.config.sections import SimulationAnnotations
from gen2d.config.splits import CHANGES, MAX_SPLITS
from gen2d.core.errors import ConfigError

Schema = dict[str, Any]
DIALECT = "https://json-schema.org/draft/2020-12/schema"
USER_FILE = {"type": "string", "pattern": r"\.py$"}
DIGEST = {"type": ["string", "null"], "description": "sha256 of a user's own file"}
MAX_INTEGER = 2**31 - 2  # magnitude of the ends of a range of whole numbers
NULL: Schema = {"type": "null"}


def json_schema(family: str | None = None) -> Schema:
    """The JSON Schema of all configs, or of those of one scene family, whose factors are then checked in splits too.

    Raises ConfigError for an unknown family.
    """
    if family is not None and family not in plugins.names("scene"):
        nearest = plugins.nearest(family, plugins.names("scene"))
        raise ConfigError(f"config schema is asked for {family!r}, which is no scene family; {nearest}")
    definitions: Schema = {}
    families = plugins.names("scene") if family is None else [family]
    sections = {name: _section(options, definitions) for name, options in SECTIONS.items()}
    sections["annotations"] = _annotations(definitions)
    sections["scene"] = _plugin("scene", families, definitions)
    sections["look"] = _plugin("look", plugins.names("look"), definitions)
    if family is not None:
        specs = factor_options(plugins.load("scene", family))
        definitions["factors"] = _factors(specs, definitions)
    definitions |= {f"section.{name}": schema for name, schema in sections.items()}
    references = {name: _reference(f"section.{name}") for name in sections}
    schema: Schema = {
        "$schema": DIALECT,
        "title": "gen2d config" if family is None else f"gen2d config of {family}",
        "type": "object",
        "properties": {
            "name": {
                "type": "string",
                "pattern": r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$",
                "description": "name of the dataset; by default that of the file",
            },
            "seed": {"type": "integer", "minimum": 0, "maximum": MAX_SEED, "default": 0, "description": "seed"},
            "licence": {
                "type": ["string", "null"],
                "maxLength": MAX_LICENCE,
                "pattern": r"^[^\n\r\t]*$",
                "description": "licence of the dataset, such as cc-by-4.0, for its cards",
            },
            **references,
            "splits": _splits(family),
        },
        "additionalProperties": False,
        "$defs": definitions,
    }
    if family not in (None, DEFAULT_PLUGINS["scene"]):
        schema["required"] = ["scene"]
    return schema


def _reference(name: str) -> Schema:
    return {"$ref": f"#/$defs/{name}"}


def _summary(options: type) -> str:
    return (options.__doc__ or "").strip().partition("\n")[0]


def _properties(options: type, definitions: Schema) -> Schema:
    return {f.name: _option(f.metadata["option"], f.default, definitions) for f in dataclasses.fields(options)}


def _section(options: type, definitions: Schema) -> Schema:
    """Schema of a section; null is a section with its defaults."""
    return {
        "type": ["object", "null"],
        "description": _summary(options),
        "properties": _properties(options, definitions),
        "additionalProperties": False,
    }


def _annotations(definitions: Schema) -> Schema:
    schema = _section(SimulationAnnotations, definitions)
    for name in plugins.names("annotation"):
        options = plugins.load("annotation", name).options
        if isinstance(options, dataclasses.Field):
            value = _option(options.metadata["option"], options.default, definitions)
            mapping = {"properties": {"value": value, "sha256": NULL}, "required": ["value"]}
        else:
            value = {"type": "boolean"}
            mapping = {"properties": _properties(options, definitions) | {"sha256": NULL}}
        mapping |= {"type": "object", "additionalProperties": False}
        summary = plugins.summary("annotation", name)
        schema["properties"][name] = {"description": summary, "anyOf": [value, mapping]}
    return schema | {"patternProperties": {r"\.py$": True}}


def _plugin(kind: str, names: list[str], definitions: Schema) -> Schema:
    """Schema of a plug-in: its name, or a mapping with the name and the options of that plug-in."""
    known: Schema = {"enum": names}
    only = kind == "scene" and len(names) == 1
    name_of = known if only else {"anyOf": [known, USER_FILE]}
    conditions = []
    for name in names:
        definitions[f"{kind}.{name}"] = {
            "description": plugins.summary(kind, name),
            "properties": {"name": True, "sha256": NULL} | _properties(plugins.load(kind, name).options, definitions),
            "additionalProperties": False,
        }
        named = {"type": "object", "properties": {"name": {"const": name}}}
        if name != DEFAULT_PLUGINS[kind]:
            named["required"] = ["name"]
        conditions.append({"if": named, "then": _reference(f"{kind}.{name}")})
    mapping: Schema = {"type": "object", "properties": {"name": name_of, "sha256": DIGEST}, "allOf": conditions}
    options = [name_of, mapping]
    if DEFAULT_PLUGINS[kind] in names:
        options.append(NULL)
    else:
        mapping["required"] = ["name"]
    return {"anyOf": options}


def _splits(family: str | None) -> Schema:
    count = {"type": ["integer", "null"], "minimum": 1, "maximum": 2**32 - 1}
    changes = {name: _reference(f"section.{name}") for name in CHANGES if name != "look"}
    split = {
        "type": ["object", "null"],
        "properties": {
            "videos": count | {"description": "number of videos; null: the number asked for"},
            "frames": count | {"description": "number of leading frames that a reader gets; null: all"},
            "factors": _reference("factors") if family else {"type": "object"},
            "overlaps": {
                "type": "boolean",
                "description": "whether the split may share videos with the training split",
            },
            **changes,
            "look": {"type": ["string", "object", "null"]},  # without a name, options of the config's look
        },
        "additionalProperties": False,
    }
    return {
        "type": ["object", "null"],
        "description": "splits by name; one with its own factors is held out from the training split",
        "propertyNames": {"pattern": r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"},
        "maxProperties": MAX_SPLITS,
        "additionalProperties": split,
    }


def _factors(specs: Mapping[str, Option], definitions: Schema) -> Schema:
    """Schema of a joint distribution: factors, or a composition of such distributions."""
    product = {name: _value(spec, definitions) for name, spec in specs.items()}
    operands = {"type": "array", "minItems": 1, "items": _reference("factors")}
    then = {"type": "object", "properties": product, "additionalProperties": False}
    condition = {
        "type": "object",
        "properties": {"when": _reference("factors"), "then": then},
        "required": ["when", "then"],
        "additionalProperties": False,
    }
    conditional = {"type": "array", "minItems": 1, "prefixItems": [_reference("factors")], "items": condition}
    return {
        "type": "object",
        "properties": product
        | {"mixture": operands, "weights": _weights(), "minus": operands, "intersection": operands}
        | {"condition": conditional},
        "additionalProperties": False,
    }


def _weights() -> Schema:
    weight = {"type": "number", "exclusiveMinimum": 0, "maximum": MAX_MAGNITUDE}
    return {"type": ["array", "null"], "items": weight}


def _option(spec: Option, default: Any, definitions: Schema) -> Schema:
    """Schema of an option with its default, unit and meaning."""
    unit = {"x-unit": spec.unit} if spec.unit not in ("", "1") else {}
    meaning = f"{spec.meaning} ({spec.unit})" if unit else spec.meaning
    return {"description": meaning, **unit, "default": plain_value(default), **_value(spec, definitions)}


def _value(spec: Option, definitions: Schema) -> Schema:
    """Schema of the values of an option."""
    single = _distribution(spec, definitions) if spec.draw else _single(spec)
    forms = [single]
    if spec.several:
        forms.append({"type": "array", "items": single, "minItems": 1})
    elif spec.parts:
        forms = [{"type": "array", "items": single, "minItems": spec.parts, "maxItems": spec.parts}]
    if spec.optional:
        forms.append(NULL)
    return forms[0] if len(forms) == 1 else {"anyOf": forms}


def _single(spec: Option) -> Schema:
    if spec.kind is bool:
        return {"type": "boolean"}
    if spec.kind is str:
        return {"enum": list(spec.choices)} if spec.choices else {"type": "string"}
    return _number(spec)


def _number(spec: Option | None, whole: bool = False) -> Schema:
    """Schema of a number in an option's range."""
    low = -MAX_MAGNITUDE if spec is None or spec.low is None else spec.low
    high = MAX_MAGNITUDE if spec is None or spec.high is None else spec.high
    above = {"exclusiveMinimum": spec.above} if spec is not None and spec.above is not None else {}
    kind = "integer" if whole or (spec is not None and spec.kind is int) else "number"
    return {"type": kind, "minimum": low, "maximum": high, **above}


def _distribution(spec: Option, definitions: Schema) -> Schema:
    """Reference to the definition of the distributions whose values are in an option's range."""
    whole = spec.kind is int
    free = Option(spec.kind, "", "", draw=True)
    limits = [f"{end} {value:g}" for end in ("above", "low", "high") if (value := getattr(spec, end)) is not None]
    name = " ".join(["whole" if whole else "real", *limits])
    if name not in definitions:
        definitions[name] = {}  # a mixture refers to the definition that is being written
        anything = _reference(name) if not limits else _distribution(free, definitions)
        definitions[name] = _forms(spec, _reference(name), anything)
    return _reference(name)


def _forms(spec: Option, own: Schema, anything: Schema) -> Schema:
    """Schema of all forms of a distribution: `own` is that of its parts, `anything` that of parts without limits."""
    whole, number = spec.kind is int, _number(spec)
    limited = any(end is not None for end in (spec.low, spec.above, spec.high))
    bounded = {"minimum": max(number["minimum"], -MAX_INTEGER), "maximum": min(number["maximum"], MAX_INTEGER)}
    whole_number = _number(spec, whole=True) | bounded
    positive = number if "exclusiveMinimum" in number or number["minimum"] > 0 else number | {"exclusiveMinimum": 0}
    many = {"type": "array", "minItems": 1, "maxItems": MAX_NUMBERS}
    operands = {"type": "array", "minItems": 1, "maxItems": MAX_PARTS}
    kinds: Schema = {
        "uniform": _pair(whole_number if whole else number),
        "integer": _pair(whole_number),
        "choice": many | {"items": number},
        "grid": many | {"items": number, "uniqueItems": True},
        "constant": {"type": "array", "minItems": 1, "maxItems": 1, "items": number},
    }
    if not whole:
        ends = [_number(None), {"type": "number", "exclusiveMinimum": 0, "maximum": MAX_MAGNITUDE}]
        normal = {"type": "array", "prefixItems": [*ends, number, number]}
        exactly_two = {"type": "array", "prefixItems": ends, "minItems": 2, "maxItems": 2}
        four = normal | {"minItems": 4, "maxItems": 4}
        kinds["log_uniform"] = _pair(positive)
        kinds["normal"] = four if limited else {"anyOf": [exactly_two, four]}
    mixture = {"mixture": operands | {"items": own}, "weights": _weights()}
    composed = [_keyed("mixture", mixture)]
    composed += [_keyed(kind, {kind: operands | {"items": anything}}) for kind in ("minus", "intersection")]
    named = [_keyed(kind, {kind: numbers}) for kind, numbers in kinds.items()]
    return {"anyOf": [number, _pair(whole_number if whole else number), *named, *composed]}


def _pair(number: Schema) -> Schema:
    return {"type": "array", "items": number, "minItems": 2, "maxItems": 2}


def _keyed(key: str, properties: Schema) -> Schema:
    return {"type": "object", "properties": properties, "required": [key], "additionalProperties": False}
