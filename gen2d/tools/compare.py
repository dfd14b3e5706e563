"""Comparison of two datasets or configs: the options, fields and programs that differ.

No code that comes with a dataset runs: its options are compared as they are stored.
"""

import dataclasses
import json
from collections.abc import Iterator, Mapping
from typing import Any, Literal

from gen2d.config import plugins
from gen2d.config.config import DEFAULT_PLUGINS, SECTIONS, load_config
from gen2d.config.distribution_syntax import COMPOSED, KINDS
from gen2d.config.options import plain_value
from gen2d.config.reading import YAML_BYTES, parse_yaml
from gen2d.config.resolved import fields_of, resolved
from gen2d.config.sections import SimulationAnnotations
from gen2d.core.errors import one_line
from gen2d.dataset.manifest import Manifest, read_manifest
from gen2d.storage.paths import Url, place
from gen2d.storage.retries import Network
from gen2d.storage.sealed import read_bytes

Kind = Literal["option", "videos", "field", "storage", "program", "machine", "version", "source", "data"]
ABSENT = "absent"


@dataclasses.dataclass(frozen=True)
class Difference:
    """An entry in which two datasets or configs differ; `first` and `second` are JSON values, None where absent.

    `lacking` says which of the two lacks the entry: first, second, or neither ("").
    """

    kind: Kind
    name: str
    first: Any
    second: Any
    lacking: str = ""

    def __str__(self) -> str:
        """The difference on one line, as `option physics.damping: 0.0 -> 0.1`."""
        ends = (ABSENT if self.lacking == end else _short(getattr(self, end)) for end in ("first", "second"))
        return one_line(f"{self.kind} {self.name}: {' -> '.join(ends)}")


@dataclasses.dataclass(frozen=True)
class _Description:
    """The comparable entries of a dataset or config by kind, each a mapping, nested where there are sections."""

    options: dict[str, Any]
    dataset: Mapping[Kind, Mapping[str, Any]] | None = None


def compare(first: str, second: str, *, timeout: float = 30.0, deadline: float = 300.0) -> list[Difference]:
    """Differences of two datasets (folders or URLs) or configs, in the order options, fields, programs.

    Of a dataset and a config, only the options and the seed are compared. `timeout` and `deadline`, in seconds, are
    those of `open`. Raises ConfigError, IncompleteError, DamagedError or UnreachableError.
    """
    one, other = (_describe(source, Network(timeout, deadline)) for source in (first, second))
    a, b = one.options, other.options
    if (one.dataset is None) != (other.dataset is None):  # the number of videos is not part of a dataset's recipe
        a, b = _without_counts(a), _without_counts(b)
    if "name" not in a or "name" not in b:
        a, b = ({key: value for key, value in options.items() if key != "name"} for options in (a, b))
    found = list(_differences("option", a, b))
    if one.dataset is not None and other.dataset is not None:
        for kind in one.dataset:
            if kind != "data" or not found:  # other data are the consequence of any other difference
                found += _differences(kind, one.dataset[kind], other.dataset[kind])
    return found


def _describe(source: str, network: Network) -> _Description:
    root = place(source, network)
    if isinstance(root, Url) or root.is_dir():
        return _describe_dataset(read_manifest(root))
    path = plugins.find_config(source)
    options = resolved(load_config(source))
    written = parse_yaml(read_bytes(path, YAML_BYTES).decode(), str(path))
    if "name" not in (written or {}):  # the file's own name, which is no option
        del options["name"]
    return _Description(options)


def _describe_dataset(manifest: Manifest) -> _Description:
    options = {**manifest.config, "seed": manifest.seed}
    for section, values in options.items():
        declared = _declared(section, values)
        if declared:
            options[section] = {**{name: plain_value(field.default) for name, field in declared.items()}, **values}
    fields = {name: f"{f.dtype} [{f.axes}] {f.unit}".rstrip() for name, f in manifest.fields.items()}
    producer = {key: value for key, value in manifest.producer.items() if isinstance(value, str)}
    machine = {key: value for key, value in manifest.fingerprint.items() if key not in ("programs", *producer)}
    keys = "schema", "rng", "conventions", "codec", "chunk_frames", "videos_per_shard", "sizes"
    return _Description(
        options,
        {
            "videos": manifest.splits,
            "field": fields,
            "storage": {key: manifest.plain.get(key) for key in keys},
            "program": _mapping(manifest.fingerprint.get("programs")),
            "machine": machine,
            "version": producer,
            "source": _mapping(manifest.producer.get("sources")),
            "data": {split: table.sha256 for split, table in manifest.tables.items()},
        },
    )


def _declared(section: str, values: Any) -> Mapping[str, dataclasses.Field[Any]]:
    """Fields of a stored section's options by name, whose defaults it may lack; none of a user's own plug-in."""
    if not isinstance(values, Mapping):
        return {}
    if section in SECTIONS:
        return fields_of(SECTIONS[section])
    if section == "annotations":
        pixels = {name: plugins.load("annotation", name).options for name in plugins.names("annotation")}
        single = {name: field for name, field in pixels.items() if isinstance(field, dataclasses.Field)}
        return {**fields_of(SimulationAnnotations), **single}
    if section in DEFAULT_PLUGINS and (name := values.get("name")) in plugins.names(section):
        return fields_of(plugins.load(section, str(name)).options)
    return {}


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _without_counts(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options without the splits' numbers of videos."""
    splits = {
        name: {key: value for key, value in _mapping(split).items() if key != "videos"}
        for name, split in _mapping(options.get("splits")).items()
    }
    return {**options, **({"splits": splits} if splits else {})}


def _differences(
    kind: Kind, first: Mapping[str, Any], second: Mapping[str, Any], path: str = ""
) -> Iterator[Difference]:
    for key in dict.fromkeys([*first, *second]):
        name = f"{path}{key}"
        one, other = first.get(key), second.get(key)
        lacking = "first" if key not in first else "second" if key not in second else ""
        if isinstance(one, Mapping) and isinstance(other, Mapping) and not (_is_leaf(one) or _is_leaf(other)):
            yield from _differences(kind, one, other, f"{name}.")
        elif lacking or one != other or isinstance(one, bool) != isinstance(other, bool):
            yield Difference(kind, name, one, other, lacking)


def _is_leaf(value: Mapping[str, Any]) -> bool:
    """Whether a mapping is a distribution."""
    return bool(value.keys() & {*KINDS, *COMPOSED, "condition"})


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    if len(text) == 64 and not set(text) - set("0123456789abcdef"):
        return text[:12]
    return text if len(text) <= 100 else f"{text[:97]}..."
