"""YAML and `--set` as plain values, of bounded size."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from gen2d.config.plugin_options import named
from gen2d.core.errors import ConfigError

# Reading ------------------------------------------------------------------------------------------------------------


class _Loader(yaml.SafeLoader):
    """YAML with 1e-3 as a number (YAML 1.1 takes it for text) and without silently doubled keys."""


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict:
    seen = set()
    for key, _ in node.value:
        if not isinstance(key.value, str):
            raise yaml.constructor.ConstructorError(None, None, "a name must be text", key.start_mark)
        if key.value in seen:
            raise yaml.constructor.ConstructorError(None, None, f"{key.value} stands there twice", key.start_mark)
        seen.add(key.value)
    return loader.construct_mapping(node, deep=True)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d[\d_]*)(\.[\d_]*)?[eE][-+]?\d+$"), list("-+0123456789")
)


_Loader.add_constructor("tag:yaml.org,2002:map", _mapping)

YAML_BYTES = 2**20  # of a config
YAML_DEPTH, YAML_NODES = 40, 50_000  # of what it stands for, each alias as often as it stands there


def _check_bounds(text: str) -> None:
    """Raises ConfigError for a YAML text that stands for more than a config could be, before it is read."""
    sizes: dict[str, int] = {}  # of what has an anchor
    open_nodes: list[tuple[str | None, int]] = []  # anchor, and how many nodes there were before
    nodes = 0
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.AliasEvent):
            nodes += sizes.get(event.anchor, 1)  # one that is not known, or open still, is an error later
        elif isinstance(event, yaml.ScalarEvent):
            nodes += 1
            sizes |= {event.anchor: 1} if event.anchor else {}
        elif isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append((event.anchor, nodes))
            nodes += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_nodes.pop()
            sizes |= {anchor: nodes - before} if anchor else {}
        if len(open_nodes) > YAML_DEPTH:
            raise yaml.YAMLError(f"nested more than {YAML_DEPTH} deep")
        if nodes > YAML_NODES:
            raise yaml.YAMLError(f"more than {YAML_NODES:,} values")


def parse_yaml(text: str, source: str) -> Any:
    """The value that a YAML text stands for."""
    try:
        _check_bounds(text)
        return yaml.load(text, _Loader)
    except RecursionError:
        raise ConfigError(f"{source}: not valid YAML: it holds itself") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        raise ConfigError(f"{source}: not valid YAML{where}: {getattr(error, 'problem', None) or error}") from None
    except ValueError as error:  # a date that does not exist
        raise ConfigError(f"{source}: not valid YAML: {error}") from None


def overridden(values: dict, overrides: Sequence[str]) -> dict:
    """The mapping with each `a.b=value` put in its place."""
    for text in overrides:
        path, equals, value = text.partition("=")
        own = re.fullmatch(r"(annotations)\.(.+\.py)(?:\.([^.]+))?", path.strip())  # a file's path may have dots
        keys = [key for key in own.groups() if key] if own else path.strip().split(".")
        if not equals or not all(keys):
            raise ConfigError(f"--set is {text!r}, but must be section.option=value, such as physics.substeps=8")
        place = values
        for key in keys[:-1]:
            inner = place.get(key)
            if not isinstance(inner, str | Mapping | None):
                raise ConfigError(f"--set is {text!r}, but {key} is {inner!r}, which has no options of its own")
            place[key] = dict(named(inner) or {})
            place = place[key]
        place[keys[-1]] = parse_yaml(value, f"--set {path}")
    return values
