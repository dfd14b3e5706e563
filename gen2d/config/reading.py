"""YAML 1.2 texts of bounded size, read and written as plain values; `--set` overrides."""

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, DocumentStartEvent, ScalarEvent

from gen2d.config.plugin_options import named
from gen2d.core.errors import ConfigError, argument

YAML_BYTES = 2**20  # size of a config file, at most
YAML_DEPTH, YAML_NODES = 40, 50_000  # levels and nodes of a text, at most; an alias counts as its expanded nodes
YAML_DIGITS = 1000  # characters of a number, at most; Python prints no integer of more than 4300 digits


def parse_yaml(text: str, source: str) -> Any:
    """Plain value of a YAML text. Raises ConfigError, naming `source`, if the text is invalid or too large."""
    try:
        _check_events(text)
        yaml = _yaml()
        yaml.composer.warn_double_anchors = False  # the later anchor counts, as YAML defines it
        return yaml.load(text)
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        raise ConfigError(f"{source}: not valid YAML{where}: {getattr(error, 'problem', None) or error}") from None
    except (ValueError, AssertionError) as error:  # an impossible date, an unknown YAML version
        raise ConfigError(f"{source}: not valid YAML: {error}") from None


def _check_events(text: str) -> None:
    """Raise YAMLError, before any value is constructed, if a text exceeds the limits or uses features not allowed."""
    sizes: dict[str, int] = {}  # nodes under each anchor
    open_nodes: list[tuple[str | None, int]] = []  # anchor of each open collection, and the number of nodes before it
    nodes = 0
    if re.search(r"!\S{1000}", text):  # ruamel.yaml takes quadratic time over a tag
        raise YAMLError("a tag of more than 1,000 characters")
    for event in _yaml().parse(text):
        if isinstance(event, DocumentStartEvent) and event.version not in (None, (1, 2)):
            raise YAMLError("its %YAML line must say 1.2")
        if isinstance(event, ScalarEvent | CollectionStartEvent) and event.ctag is not None:
            raise YAMLError("tags such as !!binary are not allowed")
        if isinstance(event, AliasEvent):
            if any(event.anchor == anchor for anchor, _ in open_nodes):
                raise YAMLError(f"&{event.anchor} contains itself")
            nodes += sizes.get(event.anchor, 1)  # the composer refuses an unknown anchor
        elif isinstance(event, ScalarEvent):
            if event.implicit[0] and len(event.value) > YAML_DIGITS and event.value[0] in "+-0123456789":
                raise YAMLError(f"a number of more than {YAML_DIGITS:,} characters")
            nodes += 1
            sizes |= {event.anchor: 1} if event.anchor else {}
        elif isinstance(event, CollectionStartEvent):
            open_nodes.append((event.anchor, nodes))
            nodes += 1
        elif isinstance(event, CollectionEndEvent):
            anchor, before = open_nodes.pop()
            sizes |= {anchor: nodes - before} if anchor else {}
        if len(open_nodes) > YAML_DEPTH:
            raise YAMLError(f"nested more than {YAML_DEPTH} deep")
        if nodes > YAML_NODES:
            raise YAMLError(f"more than {YAML_NODES:,} values")


def yaml_text(values: Mapping[str, Any]) -> str:
    """YAML text of plain values, in their order; `parse_yaml` reads equal values from it."""
    yaml, text = _yaml(), io.StringIO()
    yaml.default_flow_style = yaml.allow_unicode = False
    yaml.width = 2**31  # characters of a line; texts folded by ruamel.yaml may be read back with other spaces
    yaml.representer.sort_base_mapping_type_on_output = False
    yaml.dump(values, text)
    return text.getvalue()


def _yaml() -> YAML:
    """A YAML reader and writer of plain values; it keeps state, so each text needs a new one."""
    return YAML(typ="safe", pure=True)


def overridden(values: dict, overrides: Sequence[str]) -> dict:
    """The mapping, changed in place by overrides `section.option=value`. Raises ConfigError if one is malformed."""
    if isinstance(overrides, str):
        raise ConfigError(f"{argument('set')} is {overrides!r}, but must be a list, such as ['physics.substeps=8']")
    for text in overrides:
        path, equals, value = text.partition("=")
        user_file = re.fullmatch(r"(annotations)\.(.+\.py)(?:\.([^.]+))?", path.strip())  # a file's path may have dots
        keys = [key for key in user_file.groups() if key] if user_file else path.strip().split(".")
        if not equals or not all(keys):
            raise ConfigError(
                f"{argument('set')} is {text!r}, but must be section.option=value, such as physics.substeps=8"
            )
        mapping = values
        for key in keys[:-1]:
            inner = mapping.get(key)
            if not isinstance(inner, str | Mapping | None):
                raise ConfigError(
                    f"{argument('set')} is {text!r}, but {key} is {inner!r}, which has no options of its own"
                )
            mapping[key] = dict(named(inner) or {})
            mapping = mapping[key]
        mapping[keys[-1]] = parse_yaml(value, f"{argument('set')} {path}")
    return values
