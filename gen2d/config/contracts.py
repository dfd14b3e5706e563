"""What a plug-in declares: the file of a family, look, annotation or export ends with one constant of these types.

Arrays are jax's. [] is a scalar; K is the number of slots, T of frames, H and W the frame's size in pixels.
"""

import dataclasses
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gen2d.core.schema import Field


@dataclasses.dataclass(frozen=True, eq=False)
class _Contract:
    def __post_init__(self) -> None:
        """Raises TypeError for a member of the wrong type, with one sentence."""
        for field in dataclasses.fields(self):
            value, union = getattr(self, field.name), isinstance(field.type, types.UnionType)
            kind: Any = field.type if union else typing.get_origin(field.type) or field.type
            if kind is not Any and not isinstance(value, kind):
                raise TypeError(f"{type(self).__name__}.{field.name} is {value!r}, but must be of type {field.type}")
        options: Any = getattr(self, "options", None)
        if options is not None and not all("option" in field.metadata for field in option_fields(options)):
            raise TypeError(f"{type(self).__name__}.options is {options!r}, of which not every field is an option(...)")


def option_fields(options: Any) -> tuple[dataclasses.Field, ...]:
    """The fields of a dataclass of options, or a single option itself."""
    return (options,) if isinstance(options, dataclasses.Field) else dataclasses.fields(options)


def _nothing(options: Any) -> None:
    """No check."""


def _no_sizes(*_: Any) -> dict[str, int]:
    """No axes of its own."""
    return {}


@dataclasses.dataclass(frozen=True, eq=False)
class Family(_Contract):
    """A scene family: `FAMILY = Family(options=Options, layout=layout, sample=sample)` in gen2d/scenes/NAME.py.

    options: a frozen dataclass whose fields are made by `option`. Those with `draw=True` are the factors.
    layout(options): the `Layout`, which must hold whatever `sample` may return.
    sample(key, factors, options): the `SampledScene` of one video, traced by jax. `factors` holds an array for each
        drawn option: [], with `each` [count], with `parts` [parts] or [count, parts].
    check(options): raises ValueError where these options cannot make a scene. Its message begins with an option's name.
    sizes(options): the lengths of the axes that `each` names, where that is no drawn option.
    derived: the fields stored as factors/NAME that follow from the factors, by NAME: `SampledScene.derived` has them.
    crowded_by: the options that decide whether every object finds a place, for the error where one does not.
    begins_outside: whether objects that move may start outside the layout's bounds.
    """

    options: type
    layout: Callable[[Any], Any]
    sample: Callable[[Any, Any, Any], Any]
    check: Callable[[Any], None] = _nothing
    sizes: Callable[[Any], Mapping[str, int]] = _no_sizes
    derived: Mapping[str, Field] = dataclasses.field(default_factory=dict)
    crowded_by: tuple[str, ...] = ()
    begins_outside: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class Look(_Contract):
    """A look: `LOOK = Look(options=Options, paint=paint, margin=line_margin)` in renderers/looks/NAME.py.

    options: a frozen dataclass whose fields are made by `option`, often a subclass of `PlainOptions`.
    paint(scene, layout, options, key): the `Paint` of one video, with an entry for each of the K slots, traced by jax.
    margin(options): px, the farthest that an object is drawn beyond its own rim: `line_margin` for `LineOptions`.
    check(options): raises ValueError for options that cannot be. Its message begins with an option's name.
    """

    options: type
    paint: Callable[[Any, Any, Any, Any], Any]
    margin: Callable[[Any], float]
    check: Callable[[Any], None] = _nothing


@dataclasses.dataclass(frozen=True, eq=False)
class Annotation(_Contract):
    """What is true of a video's pixels: `ANNOTATION = Annotation(...)` in gen2d/annotations/NAME.py.

    options: one `option`, written `NAME: value` in a config and off where it is false or 0; or a frozen dataclass of
        several, written `NAME: {...}`, with `NAME: true` for the defaults. None of them is drawn.
    fields: what is stored, by its full name. The axes begin with n; T, K, H and W are known, others are in `sizes`.
    annotate(scenes, owners, plan, value): an array for each field, with the n videos first, traced by jax. `scenes` is
        a `RenderScene` of n videos, `owners` [n, T, H, W] uint8 holds the slot + 1 that a pixel shows (0 background,
        255 an occluder), `plan` is the `FramePlan` and `value` that of the option, or the dataclass.
    sizes(plan, value): the lengths of the axes that no other field has, by their letters.
    owners: whether `annotate` needs `owners`, which is None otherwise unless another annotation needs them.
    usual: the value in a config with which `gen2d.render` switches the annotation on where its fields are asked for.
    """

    options: type | dataclasses.Field
    fields: Mapping[str, Field]
    annotate: Callable[[Any, Any, Any, Any], Mapping[str, Any]]
    sizes: Callable[[Any, Any], Mapping[str, int]] = _no_sizes
    owners: bool = False
    usual: Any = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(field.metadata["option"].draw for field in option_fields(self.options)):
            raise TypeError(
                f"Annotation.options is {self.options!r}, but an annotation draws nothing: remove draw=True"
            )


@dataclasses.dataclass(frozen=True, eq=False)
class Export(_Contract):
    """A format of another program: `EXPORT = Export(fields=..., write=write)` in gen2d/exports/formats/NAME.py.

    fields: names of fields, or patterns such as "states/*", that are exported unless others are asked for. Frames that
        are not stored are drawn where "frames" is among them.
    write(target, source): fills the folder `target` with the videos of the `Source`, or writes the file of that name.
    check(source): raises ConfigError where the format cannot hold these videos, before anything is written.
    fixed: whether the format can hold no other fields.
    suffix: the ending of the one file that is written; "" where it is a folder.
    loss: what is not kept, for a person; "" if all is.
    """

    fields: tuple[str, ...]
    write: Callable[[Path, Any], None]
    check: Callable[[Any], None] = _nothing
    fixed: bool = False
    suffix: str = ""
    loss: str = ""
