"""The Config: every option of a dataset, read from YAML and checked once, here.

Each error is one sentence that names the file, the field, its value and the values allowed.
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
from gen2d.config.annotations import Annotations, parse_annotations
from gen2d.config.joint_distribution import JointDistribution, on_grid
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
from gen2d.core import palettes
from gen2d.core.errors import ConfigError, argument
from gen2d.storage.explain import reason
from gen2d.storage.image_folder import newest_images
from gen2d.storage.sealed import read_bytes

MAX_SEED = 2**63 - 1
MAX_LICENCE = 100  # characters


@dataclasses.dataclass(frozen=True)
class Config:
    """All options that determine a dataset, except its number of videos."""

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
    licence: str = ""  # of the dataset, for its cards; "" if none was chosen

    def plain(self) -> dict[str, Any]:
        """The config as plain YAML and JSON values, with every default filled in."""
        sections = {s: plain_of(getattr(self, s)) for s in SECTIONS} | {"annotations": self.annotations.plain()}
        plugs = {p: getattr(self, p).plain() for p in DEFAULT_PLUGINS}
        splits = {"splits": {split.name: split.plain() for split in self.splits}} if self.splits else {}
        licence = {"licence": self.licence} if self.licence else {}  # without one, configs keep their hashes
        return {"name": self.name, "seed": self.seed, **licence, **sections, **plugs, **splits}

    def text(self) -> str:
        """The resolved config as YAML; reading it gives an equal config."""
        return yaml_text(self.plain())

    def recipe_text(self) -> str:
        """The recipe and its seed as YAML, as a dataset stores them; the number of videos is not part of it."""
        return yaml_text({"name": self.name, "seed": self.seed, **self.recipe()})

    @property
    def copies(self) -> Copies:
        """Contents of the user's plug-in files, by their names in the config."""
        looks = [split.sections["look"] for split in self.splits if "look" in split.sections]
        used = self.scene, self.look, *looks, *self.annotations.pixels
        return {plugin.name: plugin.content for plugin in used if plugin and plugin.sha256}

    def recipe(self) -> dict[str, Any]:
        """The plain config without the splits' video counts and the seed, which a dataset compares separately."""
        plain = {key: value for key, value in self.plain().items() if key != "seed"}
        for split in plain.get("splits", {}).values():
            split.pop("videos", None)
        return plain

    @property
    def training(self) -> Split | None:
        """The split that others are compared with: `train`, else the first; None if the config has no splits."""
        return next((split for split in self.splits if split.name == "train"), next(iter(self.splits), None))

    def split_index(self, split: str) -> int:
        """Index of a split in the config; 0 if there are no splits. Raises ConfigError if the name is unknown."""
        split_names = [s.name for s in self.splits]
        if split_names and split not in split_names:
            raise ConfigError(
                f"{argument('split')} is {split!r}, but must be one of the config's: {', '.join(split_names)}"
            )
        return split_names.index(split) if split_names else 0

    @property
    def joint_distributions(self) -> list[JointDistribution]:
        """Joint distributions of the splits, in order; that of the scene alone if there are no splits."""
        return distributions_of_splits(self.scene, self.splits)

    def frames_of(self, split: str) -> int:
        """Number of leading frames of a split's videos that its reader gets."""
        frames = self.splits[self.split_index(split)].frames if self.splits else None
        return frames or self.video.frames

    def of_split(self, name: str) -> "Config":
        """The config of one split, with the split's own physics, camera, image or look in place."""
        return dataclasses.replace(self, **self.splits[self.split_index(name)].sections) if self.splits else self

    def sha256(self) -> str:
        """Hash of the recipe, in hexadecimal."""
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
DEFAULT_PLUGINS = {"scene": "bouncing", "look": "flat"}


def _merge_section(section: Mapping[str, Any], changes: Any) -> Any:
    """A section with a split's changes; a split that names another plug-in starts from that one's defaults."""
    changes = named(changes)
    if not isinstance(changes, Mapping):
        return changes  # reading it raises the error
    name = section.get("name")
    return {**section, **changes} if changes.get("name", name) == name else dict(changes)


def checked_seed(value: Any, what: str = "") -> int:
    """The seed, an integer from 0 to 2**63 - 1. Raises ConfigError, naming `what`, for other values."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_SEED:
        raise ConfigError(f"{what or argument('seed')} is {value!r}, but must be a whole number from 0 to 2**63 - 1")
    return value


def _parse_section(name: str, values: Any, source: str, copies: Copies) -> Any:
    """A section's options, or its plug-in."""
    if name in DEFAULT_PLUGINS:
        plugin = plugin_of(name, values, DEFAULT_PLUGINS[name], source, copies)
        return _with_images(plugin, source) if name == "look" else plugin
    if name == "annotations":
        return parse_annotations({} if values is None else values, source, copies)
    return build(SECTIONS[name], {} if values is None else values, name, source)


def _with_images(look: Plugin, source: str) -> Plugin:
    """The look with the hashes of the images of its backgrounds: by default, those of the folder named last.

    Raises ConfigError if they are no hashes, or if none are given and no folder was named.
    """
    if getattr(look.options, "background_kind", "") != "images":
        return look
    digests = look.options.background_images or newest_images()
    if not digests:
        raise ConfigError(
            f"{source}: look.background_kind is images, but no folder of images is named in {argument('images')}"
        )
    for digest in digests:
        if not re.fullmatch(r"[0-9a-f]{64}", digest):
            raise ConfigError(
                f"{source}: look.background_images has {digest!r:.80}, but must have sha256, 64 hexadecimal digits each"
            )
    return dataclasses.replace(look, options=dataclasses.replace(look.options, background_images=digests))


def from_mapping(values: Any, source: str, name: str = "dataset", copies: Copies = NO_COPIES) -> Config:
    """The Config of a mapping of sections. Raises ConfigError, naming `source`, if any part of it is invalid."""
    if not isinstance(values, Mapping):
        raise ConfigError(f"{source}: holds {type(values).__name__}, but must hold a mapping of sections")
    section_names = (*SECTIONS, "annotations", *DEFAULT_PLUGINS)
    known = ["name", "seed", "licence", *section_names, "splits"]
    for key in values:
        if key not in known:
            raise ConfigError(f"{source}: {key} is not a section; {plugins.nearest(key, known)}")
    name = values.get("name", name)
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", name):
        raise ConfigError(f"{source}: name is {name!r}, but must be letters, digits, '.', '_' and '-', 100 at most")
    seed = checked_seed(values.get("seed", 0), f"{source}: seed")
    licence = "" if values.get("licence") is None else values["licence"]
    if not isinstance(licence, str) or not licence.isprintable() or len(licence) > MAX_LICENCE:
        raise ConfigError(
            f"{source}: licence is {licence!r:.120}, but must be the name of a licence, such as cc-by-4.0, in one line "
            f"of {MAX_LICENCE} characters at most"
        )
    sections: dict[str, Any] = {s: _parse_section(s, values.get(s), source, copies) for s in section_names}
    frames, chunk = sections["video"].frames, sections["storage"].chunk_frames
    if chunk is not None and frames % chunk:
        raise ConfigError(f"{source}: storage.chunk_frames is {chunk}, but must divide video.frames, which is {frames}")
    simulated = sections["annotations"].simulated
    if simulated.captions and not simulated.contacts:
        raise ConfigError(
            f"{source}: annotations.contacts is 0, but annotations.captions needs them: 4 is a good number"
        )
    config = Config(name=name, seed=seed, licence=licence.strip(), **sections)
    _check_grids(config, source)
    try:
        quality_module.check(config.quality, {f"annotations.{name}" for name in config.annotations.enabled})
    except ValueError as error:
        raise ConfigError(f"{source}: quality.{error}") from None
    if values.get("splits"):
        config = _with_splits(config, values["splits"], source, copies)
    _check_matched(config, source)
    _check_palettes(config, source)
    _check_distortion(config, source)
    _check_annotations(config, source)
    return config


def _with_splits(config: Config, written: Any, source: str, copies: Copies) -> Config:
    scene, splits = with_splits(config.scene, written, source)
    all_copies = {**copies, **config.copies}
    copies = StoredCopies(all_copies) if isinstance(copies, StoredCopies) else all_copies
    plain, resolved = config.plain(), []
    for split in splits:
        if (split.frames or 0) > config.video.frames:
            message = f"{source}: splits.{split.name}.frames is {split.frames}, but must be video.frames"
            raise ConfigError(f"{message}, {config.video.frames}, or less")
        changes, split_sections = split.plain(), {}
        try:
            for name in (name for name in CHANGES if name in changes):
                values = _merge_section(plain[name], changes[name])
                split_sections[name] = _parse_section(name, values, "config", copies)
        except ConfigError as error:
            raise ConfigError(f"{source}: splits.{split.name}: {str(error).removeprefix('config: ')}") from None
        precision = split_sections.get("physics", config.physics).precision
        if precision != config.physics.precision:
            message = f"{source}: splits.{split.name}.physics.precision is {precision!r}, but must be that of all"
            raise ConfigError(f"{message} splits, {config.physics.precision}")
        if "look" in split_sections and split_sections["look"].sha256:
            changes["look"] = named(changes["look"]) | {"sha256": split_sections["look"].sha256}
        resolved.append(dataclasses.replace(split, written=json.dumps(changes), sections=split_sections))
    return dataclasses.replace(config, scene=scene, splits=tuple(resolved))


def user_plugin_files(plain: Mapping[str, Any]) -> dict[str, str]:
    """Names of the user's plug-in files in a config (`Config.plain`), by the paths of their copies in a dataset."""
    declared = [(kind, plain.get(kind)) for kind in DEFAULT_PLUGINS]
    declared += [
        (f"splits/{name}/look", _mapping(split).get("look")) for name, split in _mapping(plain.get("splits")).items()
    ]
    names = [(kind, _mapping(named(plugin)).get("name")) for kind, plugin in declared]
    names += [("annotation", name) for name in _mapping(plain.get("annotations"))]
    return {plugins.copy_name(kind, name): name for kind, name in names if plugins.is_user_file(name)}


def _mapping(value: Any) -> Mapping[Any, Any]:
    """The value if it is a mapping, else an empty mapping."""
    return value if isinstance(value, Mapping) else {}


def _check_palettes(config: Config, source: str) -> None:
    """Raise ConfigError if a split has other colours, but a palette replaces those of the scene."""
    for split in config.splits:
        look = config.of_split(split.name).look
        hidden = [name for name in _keys(split.plain().get("factors")) if name.partition("[")[0].endswith("color")]
        if hidden and palettes.palette_of(look.options) is not None:
            raise ConfigError(
                f"{source}: splits.{split.name}.factors has {hidden[0]}, which look.palette={look.options.palette} "
                "replaces: look.palette must be scene"
            )


def _check_distortion(config: Config, source: str) -> None:
    """Raise ConfigError if frames are distorted, but an annotation describes frames without distortion."""
    images = config.image, *(config.of_split(split.name).image for split in config.splits)
    straight = [plugin.name for plugin in config.annotations.wanted if not plugin.contract.distorted]
    if straight and any("distortion" in image.sensor for image in images):
        able = [plugin.name for plugin in config.annotations.pixels if plugin.contract.distorted]
        raise ConfigError(
            f"{source}: annotations.{straight[0]} is on, but describes frames without image.distortion: one of them "
            f"must be off ({' and '.join(able)} describe distorted frames)"
        )


def _check_annotations(config: Config, source: str) -> None:
    """Raise ConfigError if an annotation needs a part that the look, or that of a split, does not paint."""
    looks = {f"splits.{split.name}.look": config.of_split(split.name).look for split in config.splits}
    for where, look in (looks or {"look": config.look}).items():
        for plugin in config.annotations.wanted:
            needed = plugin.contract.needs
            if needed and needed not in look.contract.parts:
                found = [name for name in plugins.names("look") if needed in plugins.load("look", name).parts]
                raise ConfigError(
                    f"{source}: annotations.{plugin.name} is on, but {where} is {look.name}, which paints no {needed}: "
                    f"it must be off, or the look one of {', '.join(found)}"
                )


def _keys(values: Any) -> list[str]:
    """All keys of nested mappings and lists."""
    if isinstance(values, Mapping):
        return [name for key, value in values.items() for name in (key, *_keys(value))]
    return [name for value in values for name in _keys(value)] if isinstance(values, list | tuple) else []


def _check_matched(config: Config, source: str) -> None:
    """Raise ConfigError if the matched sets are impossible for this scene."""
    sections = config.scene, config.video, config.annotations.simulated, config.camera
    try:
        matched_module.check(config.matched, MatchedOptions(), *sections)
        for look in (config.look, *(config.of_split(split.name).look for split in config.splits)):
            matched_module.check_look(config.matched, config.scene, look)
        if config.matched.change and quality_module.ranges(config.quality):
            raise ValueError("change is given, but a set has one scene: quality must ask for nothing")
        if config.matched.change and any(joint.gridded for joint in config.joint_distributions):
            raise ValueError("change is given, but its scenes cannot be on a grid")
    except ValueError as error:
        raise ConfigError(f"{source}: matched.{error}") from None


def _check_grids(config: Config, source: str) -> None:
    """Raise ConfigError if a grid is too large, or given for anything but a scene's factor with a number per video."""
    sections = {name: getattr(config, name) for name in SECTIONS} | {
        p: getattr(config, p).options for p in DEFAULT_PLUGINS
    }
    for section, options in sections.items():
        for field in dataclasses.fields(options):
            spec, value = field.metadata["option"], getattr(options, field.name)
            parts = coordinates(field.name, value).values() if spec.draw and value is not None else ()
            if any(map(on_grid, parts)) and (section != "scene" or spec.each):
                raise ConfigError(
                    f"{source}: {section}.{field.name} is on a grid, but only a scene's numbers of a whole video can be"
                )
    try:
        config.joint_distributions[0].combinations()
    except ValueError as error:
        raise ConfigError(f"{source}: scene must be {error}") from None


def load_config(
    config: "Config | Mapping[str, object] | str | pathlib.Path",
    overrides: Sequence[str] = (),
    copies: Copies = NO_COPIES,
) -> Config:
    """The Config of a file's name or path, of a mapping, or of a Config, with `overrides` such as 'physics.substeps=8'.

    `copies` holds the contents of user plug-ins by name; they serve when the files are gone or have changed. Raises
    ConfigError, in one sentence, if the config is invalid.
    """
    if isinstance(config, Config):
        return load_config(config.plain(), overrides, config.copies) if overrides else config
    if isinstance(config, Mapping):
        return _overridden_config(config, overrides, "config", "dataset", copies)
    path = plugins.find_config(str(config))
    try:
        text = read_bytes(path, YAML_BYTES).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({reason(error)})") from None
    values = parse_yaml(text, str(path))
    if values is not None and not isinstance(values, Mapping):
        raise ConfigError(f"{path}: holds {type(values).__name__}, but must hold a mapping of sections")
    stem = re.sub(r"[^A-Za-z0-9._-]+", "-", path.stem).lstrip("._-")[:100] or "dataset"
    return _overridden_config(values or {}, overrides, str(path), stem, copies)


def _overridden_config(
    values: Mapping[str, object], overrides: Sequence[str], source: str, name: str, copies: Copies
) -> Config:
    """The Config of a mapping with overrides; an error names the override that causes it, if one does."""
    try:
        return from_mapping(overridden(dict(values), overrides), source, name, copies)
    except ConfigError as error:
        head, said = f"{source}: ", str(error).removeprefix(f"{source}: ")
        named = [text for text in overrides if said.startswith(f"{text.partition('=')[0].strip()} ")]
        culprit = named[-1] if named else _first_wrong(values, overrides, source, copies)
        if culprit is None or not str(error).startswith(head):
            raise
        raise ConfigError(f"{argument('set', culprit)}: {said}") from None


def _first_wrong(values: Mapping[str, object], overrides: Sequence[str], source: str, copies: Copies) -> str | None:
    """The first override with which a valid config becomes invalid; None if there is none."""
    for count in range(len(overrides) + 1):
        try:
            from_mapping(overridden(dict(values), overrides[:count]), source, copies=copies)
        except ConfigError:
            return overrides[count - 1] if count else None
    return None
