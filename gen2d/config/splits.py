"""Splits of a config: names, sizes, joint distributions of the factors, and changed sections.

A split with its own factors is held out: unless it says `overlaps: true`, its distribution must have no point in common
with that of the training split. This is decided exactly on the two supports (joint_distribution.py).
"""

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from gen2d.config import plugins
from gen2d.config.joint_distribution import (
    Component,
    JointDistribution,
    Marginals,
    intersect,
    parse_distribution,
    union_support,
)
from gen2d.config.options import coordinates, factor_options, parse_value
from gen2d.config.plugin_options import Plugin, check_plugin
from gen2d.core.errors import ConfigError

MAX_SPLITS = 100  # splits of a config, at most
CHANGES = ("physics", "camera", "image", "look")  # sections that a split may change


@dataclasses.dataclass(frozen=True)
class Split:
    """A split of a dataset: number of videos, joint distribution of their factors, and changed sections."""

    name: str
    videos: int | None  # None: the number requested at generation
    written: str  # the split's mapping in the config, as JSON
    distribution: JointDistribution = dataclasses.field(compare=False)
    sections: Mapping[str, Any] = dataclasses.field(default_factory=dict, compare=False)  # changed sections, by name

    @property
    def frames(self) -> int | None:
        """Number of leading frames of a video that its reader gets; None for all."""
        return self.plain().get("frames")

    def plain(self) -> dict[str, Any]:
        """The split as plain YAML and JSON values."""
        return json.loads(self.written)


def _scene_marginals(scene: Plugin) -> Marginals:
    """Distributions of the scene's factors as written in its options, by coordinate."""
    options = scene.written_options or scene.options
    return {
        k: v for name in factor_options(scene.contract) for k, v in coordinates(name, getattr(options, name)).items()
    }


def distributions_of_splits(scene: Plugin, splits: Sequence[Split]) -> list[JointDistribution]:
    """Joint distributions of the splits, in order; that of the scene alone if there are no splits."""
    return [split.distribution for split in splits] or [JointDistribution((Component(1.0, _scene_marginals(scene)),))]


def with_splits(scene: Plugin, written: Any, source: str) -> tuple[Plugin, tuple[Split, ...]]:
    """The scene, with supports widened to contain those of all splits, and the splits in the order written.

    Raises ConfigError, naming `source`, if a split is invalid or shares points with the training split.
    """
    if not isinstance(written, Mapping):
        raise ConfigError(f"{source}: splits is {written!r}, but must be a mapping from names to what they are")
    if len(written) > MAX_SPLITS:
        raise ConfigError(f"{source}: splits has {len(written)} names, but must have {MAX_SPLITS} at most")
    splits: dict[str, Split] = {}
    for name in sorted(written, key=lambda name: name != "train"):  # first, as others inherit from it
        training = next(iter(splits.values()), None)
        splits[name] = _parse_split(scene, name, written[name], training, source)
        if training is not None:
            _check_held_out(training, splits[name], source)
    ordered = tuple(splits[name] for name in written)
    scene = dataclasses.replace(scene, options=_widened_options(scene, ordered), written_options=scene.options)
    check_plugin(scene, "scene", source)
    return scene, ordered


def _parse_split(scene: Plugin, name: str, written: Any, training: Split | None, source: str) -> Split:
    where, known = f"splits.{name}", ("videos", "frames", "factors", "overlaps", *CHANGES)
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", name):
        raise ConfigError(f"{source}: {where} must have a name of letters, digits, '.', '_' and '-', 64 at most")
    written = {} if written is None else written
    if not isinstance(written, Mapping):
        raise ConfigError(f"{source}: {where} is {written!r}, but must be a mapping of {', '.join(known)}")
    for key in written:
        if key not in known:
            raise ConfigError(f"{source}: {where}.{key} is not an option; {plugins.nearest(key, list(known))}")
    for key in ("videos", "frames"):
        count = written.get(key)
        if count is not None and (isinstance(count, bool) or not isinstance(count, int) or not 1 <= count < 2**32):
            raise ConfigError(f"{source}: {where}.{key} is {count!r}, but must be a whole number from 1 to 2**32 - 1")
    if not isinstance(written.get("overlaps", False), bool):
        raise ConfigError(f"{source}: {where}.overlaps is {written['overlaps']!r}, but must be true or false")
    try:
        text = json.dumps(written)
    except TypeError:
        raise ConfigError(
            f"{source}: {where} must hold nothing but texts, numbers, lists and mappings of these"
        ) from None
    if "factors" in written or training is None:
        distribution = _parse_factors(scene, written.get("factors", {}), f"{where}.factors", source)
    else:
        distribution = training.distribution
    return Split(name, written.get("videos"), text, distribution)


def _parse_factors(scene: Plugin, written: Any, where: str, source: str) -> JointDistribution:
    specs = factor_options(scene.contract)

    def read(values: Mapping[str, Any]) -> Marginals:
        distributions: Marginals = {}
        for name, value in values.items():
            if name not in specs:
                raise ConfigError(f"{source}: {where}.{name} is not a factor; {plugins.nearest(name, list(specs))}")
            try:
                distributions |= coordinates(name, parse_value(specs[name], value))
            except ValueError as error:
                raise ConfigError(f"{source}: {where}.{name} is {value!r}, but must be {error}") from None
        return distributions

    try:
        return parse_distribution(written, _scene_marginals(scene), read)
    except ValueError as error:
        raise ConfigError(f"{source}: {where} is {written!r}, but must be {error}") from None


def _check_held_out(training: Split, split: Split, source: str) -> None:
    """Raise ConfigError if a split with its own factors has a point in common with the training split."""
    written, one, other = split.plain(), training.distribution, split.distribution
    try:
        shared = intersect(one, other) if "factors" in written and not written.get("overlaps") else None
    except ValueError as error:
        raise ConfigError(f"{source}: splits.{split.name}.factors must be {error}") from None
    if shared is not None:
        point = ", ".join(
            f"{name} {value:.7g}" for name, value in shared.items() if one.spans(name) != other.spans(name)
        )
        raise ConfigError(
            f"{source}: splits.{split.name} and splits.{training.name} have videos in common, such as one of "
            f"{point or 'any factors'}; cut one of them, or say overlaps: true"
        )


def _widened_options(scene: Plugin, splits: Sequence[Split]) -> Any:
    """The scene's options, with supports that contain those of all splits."""
    supports = union_support([split.distribution for split in splits])
    changes = {}
    for name, spec in factor_options(scene.contract).items():
        components = [supports[key] for key in coordinates(name, getattr(scene.options, name))]
        changes[name] = tuple(components) if spec.parts else components[0]
    return dataclasses.replace(scene.options, **changes)
