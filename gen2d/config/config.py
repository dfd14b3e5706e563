"""What a dataset is made from: every option with its unit, default and range, read from YAML and checked once, here.

An error is one sentence with the file, the field, its value and what is allowed.
"""

import dataclasses
import hashlib
import json
import pathlib
import re
from collections.abc import Mapping, Sequence
from typing import Any

from gen2d.config import matched as matched_module
from gen2d.config import plugins
from gen2d.config import quality as quality_module
from gen2d.config.annotations import Annotations, annotations_of
from gen2d.config.joint_distribution import JointDistribution
from gen2d.config.options import build, coordinates, plain_of
from gen2d.config.plugin_options import NO_COPIES, Copies, Plugin, StoredCopies, named, plugin_of
from gen2d.config.reading import YAML_BYTES, overridden, parse_yaml, yaml_text
from gen2d.config.sections import (
    CameraOptions,
    ImageOptions,
    MatchedOptions,
    PhysicsOptions,
    QualityOptions,
    StorageOptions,
    VideoOptions,
)
from gen2d.config.splits import CHANGES, Split, distributions_of_splits, with_splits
from gen2d.core.errors import ConfigError
from gen2d.storage.explain import reason
from gen2d.storage.sealed import read_bytes

MAX_SEED = 2**63 - 1


@dataclasses.dataclass(frozen=True)
class Config:
    """Everything that decides what a dataset holds, but for its number of videos."""

    name: str
    seed: int
    video: VideoOptions
    scene: Plugin
    physics: PhysicsOptions
    camera: CameraOptions
    image: ImageOptions
    look: Plugin
    annotations: Annotations
    matched: MatchedOptions
    quality: QualityOptions
    storage: StorageOptions
    splits: tuple[Split, ...] = ()

    def plain(self) -> dict[str, Any]:
        """The config as YAML and JSON hold it, every default filled in."""
        sections = {s: plain_of(getattr(self, s)) for s in SECTIONS} | {"annotations": self.annotations.plain()}
        plugs = {p: getattr(self, p).plain() for p in PLUGINS}
        splits = {"splits": {split.name: split.plain() for split in self.splits}} if self.splits else {}
        return {"name": self.name, "seed": self.seed, **sections, **plugs, **splits}

    def text(self) -> str:
        """The resolved config as YAML; read again it gives the same config."""
        return yaml_text(self.plain())

    def recipe_text(self) -> str:
        """The recipe with its seed as YAML: what a dataset keeps, however many videos it has."""
        return yaml_text({"name": self.name, "seed": self.seed, **self.recipe()})

    @property
    def copies(self) -> Copies:
        """What the files of the user's own hold, by their names in the config."""
        looks = [split.own["look"] for split in self.splits if "look" in split.own]
        every = self.scene, self.look, *looks, *self.annotations.pixels
        return {plugin.name: plugin.content for plugin in every if plugin.sha256}

    def recipe(self) -> dict[str, Any]:
        """The config without its seed, which a dataset keeps and compares by itself, and without numbers of videos."""
        plain = {key: value for key, value in self.plain().items() if key != "seed"}
        for split in plain.get("splits", {}).values():
            split.pop("videos", None)
        return plain

    @property
    def training(self) -> Split | None:
        """The split that the others are compared with: `train`, or else the first; None where there are none."""
        return next((split for split in self.splits if split.name == "train"), next(iter(self.splits), None))

    def row(self, split: str) -> int:
        """The place of a split's law among the config's; any split has the only one where the config has none."""
        names = [own.name for own in self.splits]
        if names and split not in names:
            raise ConfigError(f"--split is {split!r}, but must be one of the config's: {', '.join(names)}")
        return names.index(split) if names else 0

    @property
    def laws(self) -> list[JointDistribution]:
        """The laws of the splits in order, or that of the scene alone."""
        return distributions_of_splits(self.scene, self.splits)

    def frames_of(self, split: str) -> int:
        """How many frames of a split's videos its reader gets, the first ones."""
        own = self.splits[self.row(split)].frames if self.splits else None
        return own or self.video.frames

    def of_split(self, name: str) -> "Config":
        """The config as it is for a split, with the look or the physics that this one has of its own."""
        return dataclasses.replace(self, **self.splits[self.row(name)].own) if self.splits else self

    def sha256(self) -> str:
        """A hash of the recipe."""
        return hashlib.sha256(json.dumps(self.recipe(), sort_keys=True).encode()).hexdigest()


SECTIONS = {
    "video": VideoOptions,
    "physics": PhysicsOptions,
    "camera": CameraOptions,
    "image": ImageOptions,
    "matched": MatchedOptions,
    "quality": QualityOptions,
    "storage": StorageOptions,
}
PLUGINS = {"scene": "bouncing", "look": "flat"}


def _merged(own: Mapping[str, Any], other: Any) -> Any:
    """A section with other options; another plug-in has its defaults."""
    other = named(other)
    if not isinstance(other, Mapping):
        return other  # reading it says what is wrong
    return dict(other) if other.get("name", own.get("name")) != own.get("name") else {**own, **other}


def checked_seed(value: Any, what: str = "--seed") -> int:
    """The seed, if it is one; `what` names it in the error."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_SEED:
        raise ConfigError(f"{what} is {value!r}, but must be a whole number from 0 to 2**63 - 1")
    return value


def _section(name: str, values: Any, source: str, copies: Copies) -> Any:
    """The options of a section, or a plug-in."""
    if name in PLUGINS:
        return plugin_of(name, values, PLUGINS[name], source, copies)
    if name == "annotations":
        return annotations_of({} if values is None else values, source, copies)
    return build(SECTIONS[name], {} if values is None else values, name, source)


def from_mapping(values: Any, source: str, name: str = "dataset", copies: Copies = NO_COPIES) -> Config:
    """The config that a mapping stands for; every error names `source`."""
    if not isinstance(values, Mapping):
        raise ConfigError(f"{source}: holds {type(values).__name__}, but must hold a mapping of sections")
    read = (*SECTIONS, "annotations", *PLUGINS)
    known = ["name", "seed", *read, "splits"]
    for key in values:
        if key not in known:
            raise ConfigError(f"{source}: {key} is not a section; {plugins.nearest(key, known)}")
    name = values.get("name", name)
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", name):
        raise ConfigError(f"{source}: name is {name!r}, but must be letters, digits, '.', '_' and '-', 100 at most")
    seed = checked_seed(values.get("seed", 0), f"{source}: seed")
    sections: dict[str, Any] = {s: _section(s, values.get(s), source, copies) for s in read}
    frames, chunk = sections["video"].frames, sections["storage"].chunk_frames
    if chunk is not None and frames % chunk:
        raise ConfigError(f"{source}: storage.chunk_frames is {chunk}, but must divide video.frames, which is {frames}")
    simulated = sections["annotations"].simulated
    if simulated.captions and not simulated.contacts:
        raise ConfigError(
            f"{source}: annotations.contacts is 0, but annotations.captions needs them: 4 is a good number"
        )
    config = Config(name=name, seed=seed, **sections)
    _check_grids(config, source)
    try:
        quality_module.check(config.quality, {f"annotations.{name}" for name in config.annotations.enabled})
    except ValueError as error:
        raise ConfigError(f"{source}: quality.{error}") from None
    if values.get("splits"):
        config = _with_splits(config, values["splits"], source, copies)
    _check_sets(config, source)
    return config


def _with_splits(config: Config, written: Any, source: str, copies: Copies) -> Config:
    scene, splits = with_splits(config.scene, written, source)
    together = {**copies, **config.copies}
    copies = StoredCopies(together) if isinstance(copies, StoredCopies) else together
    plain, made = config.plain(), []
    for split in splits:
        if (split.frames or 0) > config.video.frames:
            told = f"{source}: splits.{split.name}.frames is {split.frames}, but must be video.frames"
            raise ConfigError(f"{told}, {config.video.frames}, or less")
        changes, own = split.plain(), {}
        try:
            for name in (name for name in CHANGES if name in changes):
                own[name] = _section(name, _merged(plain[name], changes[name]), "config", copies)
        except ConfigError as error:
            raise ConfigError(f"{source}: splits.{split.name}: {str(error).removeprefix('config: ')}") from None
        if "look" in own and own["look"].sha256:
            changes["look"] = named(changes["look"]) | {"sha256": own["look"].sha256}
        made.append(dataclasses.replace(split, written=json.dumps(changes), own=own))
    return dataclasses.replace(config, scene=scene, splits=tuple(made))


def own_files(plain: Mapping[str, Any]) -> dict[str, str]:
    """The names of the user's own files in a config (`Config.plain`), by where a dataset keeps their copies."""
    places = [(kind, plain.get(kind)) for kind in PLUGINS]
    places += [
        (f"splits/{name}/look", _mapping(own).get("look")) for name, own in _mapping(plain.get("splits")).items()
    ]
    names = [(kind, _mapping(named(plugin)).get("name")) for kind, plugin in places]
    names += [("annotation", name) for name in _mapping(plain.get("annotations"))]
    own = [(kind, name) for kind, name in names if isinstance(name, str) and plugins.is_own(name)]
    return {plugins.copy_name(kind, name): name for kind, name in own}


def _mapping(value: Any) -> Mapping[Any, Any]:
    """The value if it is a mapping, else an empty one."""
    return value if isinstance(value, Mapping) else {}


def _check_sets(config: Config, source: str) -> None:
    """Raises ConfigError for matched sets that cannot be made."""
    about = config.scene, config.video, config.annotations.simulated, config.camera
    try:
        matched_module.check(config.matched, MatchedOptions(), *about)
        if config.matched.change and quality_module.ranges(config.quality):
            raise ValueError("change is given, but a set has one scene: quality must ask for nothing")
        if config.matched.change and any(law.combinations()[0] for law in config.laws):
            raise ValueError("change is given, but its scenes cannot be on a grid")
    except ValueError as error:
        raise ConfigError(f"{source}: matched.{error}") from None


def _check_grids(config: Config, source: str) -> None:
    """Raises ConfigError for a grid that is not of a scene's factor, one number a video."""
    sections = {name: getattr(config, name) for name in SECTIONS} | {p: getattr(config, p).options for p in PLUGINS}
    for section, options in sections.items():
        for field in dataclasses.fields(options):
            spec, value = field.metadata["option"], getattr(options, field.name)
            parts = coordinates(field.name, value).values() if spec.draw and value is not None else ()
            gridded = any(simple.kind == "grid" for part in parts for _, simple in part.weighted)
            if gridded and (section != "scene" or spec.each):
                raise ConfigError(
                    f"{source}: {section}.{field.name} is on a grid, but only a scene's numbers of a whole video can be"
                )


def load_config(
    config: "Config | Mapping | str | pathlib.Path", overrides: Sequence[str] = (), copies: Copies = NO_COPIES
) -> Config:
    """A Config from a file's name or path, from a mapping, or from a Config, with `overrides` ('physics.substeps=8').

    `copies` are of families and looks of the user's own, by their names, for where these are gone or have changed.
    """
    if isinstance(config, Config):
        return load_config(config.plain(), overrides, config.copies) if overrides else config
    if isinstance(config, Mapping):
        return from_mapping(overridden(dict(config), overrides), "config", copies=copies)
    path = plugins.find_config(str(config))
    try:
        text = read_bytes(path, YAML_BYTES).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({reason(error)})") from None
    values = parse_yaml(text, str(path))
    if values is not None and not isinstance(values, Mapping):
        raise ConfigError(f"{path}: holds {type(values).__name__}, but must hold a mapping of sections")
    stem = re.sub(r"[^A-Za-z0-9._-]+", "-", path.stem).lstrip("._-")[:100] or "dataset"
    return from_mapping(overridden(dict(values or {}), overrides), str(path), stem)
