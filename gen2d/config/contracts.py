"""Plug-in contracts: the file of a family, look, annotation or export ends with one constant of these types.

Arrays are jax arrays. [] is a scalar, K the number of slots, T that of frames, and H and W are the frame's height and
width in pixels.
"""

import dataclasses
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gen2d.core.enums import SHAPES
from gen2d.core.schema import Field


@dataclasses.dataclass(frozen=True, eq=False)
class _Contract:
    def __post_init__(self) -> None:
        """Raise TypeError, in one sentence, if a member has the wrong type."""
        for field in dataclasses.fields(self):
            value, union = getattr(self, field.name), isinstance(field.type, types.UnionType)
            kind: Any = field.type if union else typing.get_origin(field.type) or field.type
            if kind is not Any and not isinstance(value, kind):
                raise TypeError(f"{type(self).__name__}.{field.name} is {value!r}, but must be of type {field.type}")
        options: Any = getattr(self, "options", None)
        if options is not None and not all("option" in field.metadata for field in option_fields(options)):
            raise TypeError(f"{type(self).__name__}.options is {options!r}, of which not every field is an option(...)")
        hidden = _hidden_attribute(options)
        if hidden:
            raise TypeError(
                f"{type(self).__name__}.options has an option {hidden}, which its base class uses: rename it"
            )


def _hidden_attribute(options: Any) -> str | None:
    """Name of a field that hides an attribute of a base class which is no field there; None without one."""
    bases = options.__mro__[1:-1] if isinstance(options, type) else ()
    names = {field.name for field in option_fields(options)} if bases else set[str]()
    for base in bases:
        fields = dataclasses.fields(base) if dataclasses.is_dataclass(base) else ()
        for name in sorted(names & vars(base).keys() - {field.name for field in fields}):
            return name
    return None


def option_fields(options: Any) -> tuple[dataclasses.Field[Any], ...]:
    """Fields of a dataclass of options; a single option is its own field."""
    return (options,) if isinstance(options, dataclasses.Field) else dataclasses.fields(options)


def _nothing(options: Any) -> None:
    """Accept all options."""


def _no_blur(*_: Any) -> float:
    """No shadows."""
    return 0.0


def _few_videos(source: Any) -> int:
    """Number of videos of a part, by default."""
    return 64


def _no_finish(target: Path, source: Any) -> None:
    """Write nothing more."""


def _no_sizes(*_: Any) -> dict[str, int]:
    """No further axes."""
    return {}


@dataclasses.dataclass(frozen=True, eq=False)
class Bodies:
    """Moving bodies of one kind in a family, from which the limits of a config are computed (programs/limits.py).

    - shape: circle, capsule or box.
    - size: names of options, m: radius of a circle, radius and half length of a capsule, width and height of a box. An
        option may have both.
    - density: name of the option of their density, kg/m^2.
    - speed: names of options of their speed or velocity at the start, m/s.
    - bears: names of the bodies that may rest on one of these.
    """

    shape: str
    size: tuple[str, ...]
    density: str = "density"
    speed: tuple[str, ...] = ()
    bears: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class Family(_Contract):
    """A scene family: `FAMILY = Family(options=Options, layout=layout, sample=sample)` in gen2d/scenes/NAME.py.

    - options: frozen dataclass with fields declared by `option`. Options with `draw=True` are sampled: the factors.
    - layout(options): the `Layout`, large enough for every scene that `sample` may return.
    - sample(key, factors, options): the `SampledScene` of one video, traced by jax. `factors` has one array per factor:
        [], or [count] with `each`, [parts] with `parts`, [count, parts] with both.
        Numbers of the options are arguments of the compiled program here and in `layout`: jax, NumPy, arithmetic,
        `maximum` and `minimum` take them as they are. A comparison, `int`, or a function of `math` makes the program
        one for this outcome alone, so another number compiles again.
    - check(options): raises ValueError if no scene is possible with these options; the message begins with an option's
        name.
    - sizes(options): lengths of the axes named by `each`, for names that are not factors themselves.
    - derived: fields computed from the factors and stored as factors/NAME, by NAME; `SampledScene.derived` holds the
        values.
    - crowded_by: options to name in the error when an object finds no free position.
    - begins_outside: whether moving objects may start outside the layout's bounds.
    - bodies: `Bodies` by name, such as balls. A config whose ranges allow masses or speeds that the solver cannot
        simulate well is warned of; the bodies that are not listed are not checked.
    """

    options: type
    layout: Callable[[Any], Any]
    sample: Callable[[Any, Any, Any], Any]
    check: Callable[[Any], None] = _nothing
    sizes: Callable[[Any], Mapping[str, int]] = _no_sizes
    derived: Mapping[str, Field] = dataclasses.field(default_factory=dict[str, Field])
    crowded_by: tuple[str, ...] = ()
    begins_outside: bool = False
    bodies: Mapping[str, Bodies] = dataclasses.field(default_factory=dict[str, Bodies])


@dataclasses.dataclass(frozen=True, eq=False)
class Look(_Contract):
    """A look: `LOOK = Look(options=Options, paint=paint, margin=line_margin)` in renderers/looks/NAME.py.

    - options: frozen dataclass with fields declared by `option`, often a subclass of `PlainOptions`.
    - paint(scene, layout, options, key): the `Paint` of one video, with one entry per slot (K), traced by jax.
        `Paint.sampled` holds the values of options with `draw=True`, from `sampled_options`; they are stored as
        look/NAME.
    - margin(options): largest distance, in px, to which an object is rendered beyond its outline; `line_margin` for
        `LineOptions`.
    - grown: shapes that are rendered beyond their outlines; `LINES` if they are segments alone, which is faster.
    - blur(options, layout): largest half width of the soft edges of shadows, in m; 0 for looks without shadows.
    - check(options): raises ValueError if the options are invalid; the message begins with an option's name.
    - parts: names of parts of `Paint` that `paint` always returns, and that annotations may need: surface, shadow.
    """

    options: type
    paint: Callable[[Any, Any, Any, Any], Any]
    margin: Callable[[Any], float]
    grown: tuple[str, ...] = SHAPES
    blur: Callable[[Any, Any], float] = _no_blur
    check: Callable[[Any], None] = _nothing
    parts: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class Annotation(_Contract):
    """A pixel annotation: `ANNOTATION = Annotation(...)` in gen2d/annotations/NAME.py.

    - options: one `option`, written `NAME: value` in a config and off if false or 0; or a frozen dataclass of options,
        written `NAME: {...}`, with `NAME: true` for the defaults. None of them may be sampled (`draw=True`).
    - fields: stored fields by full name. Their axes begin with n; T, K, H and W are known, `sizes` gives all others.
    - annotate(scenes, owners, plan, value): one array per field, with the n videos first, traced by jax. `scenes` is a
        `RenderScene` of n videos. `owners` [n, T, H, W] uint8 is the slot + 1 visible at each pixel (0 background, 255
        occluder). `plan` is the `FramePlan`; `value` is the option's value, or the dataclass.
    - sizes(plan, value): lengths of further axes, by letter.
    - owners: whether `annotate` needs `owners`; without it `owners` is None, unless another annotation needs it.
    - distorted: whether it describes frames with lens distortion, too: their owners are given, and `distorted_points`
        gives the places of points. A config with another annotation and `image.distortion` is refused.
    - usual: value with which `gen2d.render` switches the annotation on when its fields are requested.
    - needs: part of `Paint`, as in `Look.parts`, without which the annotation is refused; "" if it needs none.
    """

    options: type | dataclasses.Field
    fields: Mapping[str, Field]
    annotate: Callable[[Any, Any, Any, Any], Mapping[str, Any]]
    sizes: Callable[[Any, Any], Mapping[str, int]] = _no_sizes
    owners: bool = False
    distorted: bool = False
    usual: Any = True
    needs: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(field.metadata["option"].draw for field in option_fields(self.options)):
            raise TypeError(
                f"Annotation.options is {self.options!r}, but an annotation draws nothing: remove draw=True"
            )

    @property
    def off(self) -> Any:
        """Value of a config's options where the annotation is off: the default; None for a dataclass."""
        return self.options.default if isinstance(self.options, dataclasses.Field) else None


@dataclasses.dataclass(frozen=True, eq=False)
class Export(_Contract):
    """An export format: `EXPORT = Export(fields=..., write=write)` in gen2d/exports/formats/NAME.py.

    - fields: names of the fields exported by default, or patterns such as "states/*". If "frames" is among them, frames
        that are not stored are rendered.
    - write(target, source): writes the videos of the `Source` to the folder, or to the single file, `target`.
    - check(source): raises ConfigError, before anything is written, if the format cannot hold these videos.
    - fixed: whether the format holds these fields only.
    - suffix: suffix of the single file written; "" for a folder.
    - separate: whether the files of a part of the videos depend on nothing but these, as with `source.each`, so that
        several machines may each write some parts, and a killed export goes on. `write` is then called for each part,
        and may leave files for `finish` in the folder `source.notes`.
    - part_videos(source): number of videos of a part; a part begins at a multiple of it.
    - finish(target, source): writes the files that describe all videos, if there are any, when all parts are there.
    - codecs: names of the encodings of frames that can be chosen, of which the first is the default; one is then in
        `source.codec`. `films.CODECS` has those of films, with what each does not preserve.
    - loss: description of the information that the format drops; "" if it drops none but what its codec drops.
    """

    fields: tuple[str, ...]
    write: Callable[[Path, Any], None]
    check: Callable[[Any], None] = _nothing
    fixed: bool = False
    suffix: str = ""
    separate: bool = False
    part_videos: Callable[[Any], int] = _few_videos
    finish: Callable[[Path, Any], None] = _no_finish
    codecs: tuple[str, ...] = ()
    loss: str = ""
