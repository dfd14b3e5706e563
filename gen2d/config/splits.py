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
from gen2d.config.joint_distribution import JointDistribution, Weighted, intersect, joint_distribution_of, union_support
from gen2d.config.options import coordinates, drawn_options, value_of
from gen2d.config.plugin_options import Plugin, check_plugin
from gen2d.core.errors import ConfigError

MOST = 100  # splits of a config, at most
CHANGES = ("physics", "camera", "image", "look")  # sections that a split may change


@dataclasses.dataclass(frozen=True)
class Split:
    """A split of a dataset: number of videos, joint distribution of their factors, and changed sections."""

    name: str
    videos: int | None  # None: the number requested at generation
    written: str  # the split's mapping in the config, as JSON
    law: JointDistribution = dataclasses.field(compare=False)
    own: Mapping[str, Any] = dataclasses.field(default_factory=dict, compare=False)  # changed sections, by name

    @property
    def frames(self) -> int | None:
        """Number of leading frames of a video that its reader gets; None for all."""
        return self.plain().get("frames")

    def plain(self) -> dict[str, Any]:
        """The split as plain YAML and JSON values."""
        return json.loads(self.written)


def _base(scene: Plugin) -> Weighted:
    """Distributions of the scene's factors as written in its options, by coordinate."""
    options = scene.own or scene.options
    return {
        k: v for name in drawn_options(scene.contract) for k, v in coordinates(name, getattr(options, name)).items()
    }


def distributions_of_splits(scene: Plugin, splits: Sequence[Split]) -> list[JointDistribution]:
    """Joint distributions of the splits, in order; that of the scene alone if there are no splits."""
    return [split.law for split in splits] or [joint_distribution_of({}, _base(scene), lambda written: {})]


def with_splits(scene: Plugin, written: Any, source: str) -> tuple[Plugin, tuple[Split, ...]]:
    """The scene, with supports widened to contain those of all splits, and the splits in the order written.

    Raises ConfigError, naming `source`, if a split is invalid or shares points with the training split.
    """
    if not isinstance(written, Mapping):
        raise ConfigError(f"{source}: splits is {written!r}, but must be a mapping from names to what they are")
    if len(written) > MOST:
        raise ConfigError(f"{source}: splits has {len(written)} names, but must have {MOST} at most")
    splits: dict[str, Split] = {}
    for name in sorted(written, key=lambda name: name != "train"):  # first, as others inherit from it
        training = next(iter(splits.values()), None)
        splits[name] = _split(scene, name, written[name], training, source)
        if training is not None:
            _check_held_out(training, splits[name], source)
    ordered = tuple(splits[name] for name in written)
    scene = dataclasses.replace(scene, options=_hull(scene, ordered), own=scene.options)
    check_plugin(scene, "scene", source)
    return scene, ordered


def _split(scene: Plugin, name: str, written: Any, training: Split | None, source: str) -> Split:
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
    inherited = None if "factors" in written else training
    law = (
        inherited.law if inherited else _distribution_of(scene, written.get("factors", {}), f"{where}.factors", source)
    )
    return Split(name, written.get("videos"), text, law)


def _distribution_of(scene: Plugin, written: Any, where: str, source: str) -> JointDistribution:
    specs = drawn_options(scene.contract)

    def read(values: Mapping[str, Any]) -> Weighted:
        distributions: Weighted = {}
        for name, value in values.items():
            if name not in specs:
                raise ConfigError(f"{source}: {where}.{name} is not a factor; {plugins.nearest(name, list(specs))}")
            try:
                distributions |= coordinates(name, value_of(specs[name], value))
            except ValueError as error:
                raise ConfigError(f"{source}: {where}.{name} is {value!r}, but must be {error}") from None
        return distributions

    try:
        return joint_distribution_of(written, _base(scene), read)
    except ValueError as error:
        raise ConfigError(f"{source}: {where} is {written!r}, but must be {error}") from None


def _check_held_out(training: Split, split: Split, source: str) -> None:
    """Raise ConfigError if a split with its own factors has a point in common with the training split."""
    written = split.plain()
    try:
        shared = intersect(training.law, split.law) if "factors" in written and not written.get("overlaps") else None
    except ValueError as error:
        raise ConfigError(f"{source}: splits.{split.name}.factors must be {error}") from None
    if shared is not None:
        point = ", ".join(f"{name} {value:.7g}" for name, value in shared.items() if _differ(training, split, name))
        raise ConfigError(
            f"{source}: splits.{split.name} and splits.{training.name} have videos in common, such as one of "
            f"{point or 'any factors'}; cut one of them, or say overlaps: true"
        )


def _differ(one: Split, other: Split, name: str) -> bool:
    return one.law.spans(name) != other.law.spans(name)


def _hull(scene: Plugin, splits: Sequence[Split]) -> Any:
    """The scene's options, with supports that contain those of all splits."""
    supports = union_support([split.law for split in splits])
    changes = {}
    for name, spec in drawn_options(scene.contract).items():
        components = [supports[key] for key in coordinates(name, getattr(scene.options, name))]
        changes[name] = tuple(components) if spec.parts else components[0]
    return dataclasses.replace(scene.options, **changes)
