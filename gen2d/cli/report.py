"""A dataset's data sheet, and the options of all plug-ins, as text."""

import dataclasses
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

from gen2d.core.errors import ConfigError
from gen2d.core.humanize import in_bytes, in_time
from gen2d.dataset.manifest import Manifest, read_manifest, statistics
from gen2d.storage.atomic import size_of
from gen2d.storage.paths import Place, place
from gen2d.storage.retries import Network


def _table(rows: list[tuple[str, ...]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]


def info(root: str | Place, *, timeout: float = 30.0, deadline: float = 300.0) -> str:
    """Data sheet of a dataset as text: splits, sizes, every field with its unit, statistics, versions.

    `root` is a folder or a URL; `timeout` and `deadline`, in seconds, are those of `open`. Raises IncompleteError,
    DamagedError or UnreachableError.
    """
    root = place(root, Network(timeout, deadline))
    manifest = read_manifest(root)
    splits = ", ".join(f"{name}: {count:,} videos" for name, count in manifest.splits.items())
    duration = in_time(sum(manifest.splits.values()) * manifest.sizes.get("T", 0) / manifest.fps)
    sizes = ", ".join(f"{name} = {value}" for name, value in manifest.sizes.items())
    fields = [(name, f.dtype, f.axes, f.unit, f.meaning) for name, f in manifest.fields.items()]
    versions = ", ".join(f"{key} {value}" for key, value in manifest.producer.items() if not isinstance(value, dict))
    fingerprint = ", ".join(f"{key} {value}" for key, value in _fingerprint(manifest.fingerprint))
    commands = [
        f"python -m gen2d --config config.yaml --n {count} --split {split} --seed {manifest.seed}"
        for split, count in manifest.splits.items()
    ]
    return "\n".join(
        [
            f"{manifest.name} ({root})",
            f"  {splits}; seed {manifest.seed}, {manifest.fps:g} frames/s, {duration} in total",
            f"  sizes: {sizes}",
            "",
            *_table([("field", "type", "axes", "unit", "meaning"), *fields]),
            "",
            f"  {manifest.conventions}",
            "",
            *_table([("split", "field", "mean", "standard deviation", "min", "max"), *statistics(manifest)]),
            f"  computed from {manifest.stats_sampled}",
            "",
            *_table([("on disk", "files", "size"), *_disk_usage(root, manifest)]),
            f"  frames and other images are compressed with {manifest.codec}; up to {manifest.videos_per_shard:,} "
            "videos in a shard",
            "",
            *(f"  command: {command}" for command in commands),
            f"  versions: {versions}",
            f"  fingerprint: {fingerprint}",
            f"  sha256 of the config: {manifest.config_sha256}",
            f"  licence: {manifest.licence or 'none'}",
        ]
    )


def _disk_usage(root: Place, manifest: Manifest) -> Iterator[tuple[str, ...]]:
    """Rows of name, files and size: shards of each split, and tables of shards."""
    for split, table in manifest.tables.items():
        yield f"shards of {split}", f"{table.shards:,}", in_bytes(table.bytes)
    index = [size for table in manifest.tables.values() if (size := size_of(root / table.file)) is not None]
    yield "tables of shards", f"{len(index):,}", in_bytes(sum(index))


def _fingerprint(entries: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Names and values of a fingerprint, nested ones as 'outer.inner', hashes cut to 16 characters."""
    for key, value in entries.items():
        if isinstance(value, dict):
            yield from _fingerprint(value, f"{key}.")
        else:
            text = f"{value:g}" if isinstance(value, float) else str(value)
            yield f"{prefix}{key}", (text[:16] if prefix else text) or "-"


WIDTH = 100  # characters of a line of the overview, at most
TITLES = {
    "scene": "Scene families",
    "look": "Looks",
    "annotation": "Annotations of pixels",
    "export": "Formats of exports",
}


def catalogue() -> dict[str, dict[str, str] | list[str]]:
    """Names of all plug-ins, with their summaries by kind, and of configs and sections."""
    from gen2d.config import plugins

    kinds = {kind: {name: plugins.written_summary(kind, name) for name in plugins.names(kind)} for kind in TITLES}
    return {**kinds, "config": plugins.config_names()}


def overview() -> str:
    """Names of all plug-ins and configs as text of one screen, with the summaries of scene families.

    Nothing is imported, so it is quick.
    """
    from gen2d.config import plugins

    lines: list[str] = []
    for kind, title in TITLES.items():
        if kind == "scene":
            rows = [(name, plugins.written_summary(kind, name)) for name in plugins.names(kind)]
            lines += [f"{title}:"]
            lines += [line if len(line) <= WIDTH else f"{line[: WIDTH - 4]} ..." for line in _table(rows)]
        else:
            lines += _wrapped(title, plugins.names(kind))
    lines += _wrapped("Configs", [name.removesuffix(".yaml") for name in plugins.config_names()])
    list_verb, schema = "python -m gen2d list", "python -m gen2d config schema"
    return "\n".join([*lines, f"Options: {list_verb} NAME, {list_verb} --options; {schema}"])


def _wrapped(title: str, names: list[str]) -> list[str]:
    return textwrap.wrap(f"{title}: {', '.join(names)}", WIDTH, subsequent_indent="  ", break_on_hyphens=False)


def plugins(name: str | None = None) -> str:
    """Plug-ins and configs with their options as text; only the one called `name`, if it is given.

    Raises ConfigError for an unknown name.
    """
    from gen2d.config import config, plugins  # imports jax
    from gen2d.config.sections import SimulationAnnotations

    lines: list[str] = []
    for kind, title in TITLES.items():
        known = [n for n in plugins.names(kind) if name in (None, n)]
        lines += [f"{title}:"] if known else []
        for plugin in known:
            rows = _option_table(_plugin_options(kind, plugin, plugins.load(kind, plugin)))
            lines += [f" {plugin}: {plugins.summary(kind, plugin)}", *rows, *([""] if rows else [])]
        lines += [""] if known and lines[-1] else []
    configs = [c for c in plugins.config_names() if name in (None, c, c.removesuffix(".yaml"))]
    if configs:
        lines += [f"Configs (in {plugins.config_folder()}):", *(f"  {config}" for config in configs), ""]
    if name is None:
        lines.append("Sections of every config:")
        for section, options in {**config.SECTIONS, "annotations": SimulationAnnotations}.items():
            summary = (options.__doc__ or "").strip().partition("\n")[0]
            lines += [f" {section}: {summary}", *_option_table(_options_of(section, options)), ""]
    if not lines:
        names = [*(known for kind in TITLES for known in plugins.names(kind)), *plugins.config_names()]
        raise ConfigError(f"{name!r} is not known; {plugins.nearest(name or '', names)}")
    return "\n".join(lines).rstrip()


def _plugin_options(kind: str, name: str, contract: Any) -> dict[str, dataclasses.Field[Any]]:
    """The options of a plug-in, by where they stand in a config."""
    if kind == "export":
        return {}
    if kind != "annotation":
        return _options_of(kind, contract.options)
    where, options = f"annotations.{name}", contract.options
    return {where: options} if isinstance(options, dataclasses.Field) else _options_of(where, options)


def _options_of(where: str, options: type) -> dict[str, dataclasses.Field[Any]]:
    return {f"{where}.{field.name}": field for field in dataclasses.fields(options)}


def _option_table(fields: Mapping[str, dataclasses.Field[Any]]) -> list[str]:
    rows = []
    for name, field in fields.items():
        spec = field.metadata["option"]
        unit = f" {spec.unit}" if spec.unit not in ("", "1") else ""
        meaning = f"{spec.meaning}; {spec.allowed}" + (", or a distribution" if spec.draw else "")
        rows.append((name, f"{_default(field.default)}{unit}", meaning))
    return _table(rows) if rows else []


def _default(value: Any) -> str:
    """An option's default as a config would have it."""
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_default, value)) + "]"
    if hasattr(value, "plain"):
        plain = value.plain()
        if isinstance(plain, dict) and set(plain) <= {"uniform", "integer"}:
            plain = next(iter(plain.values()))
        return str(plain).replace("'", "")
    return "null" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
