"""Annotations: ground truth of a video's pixels, one file each, named like the option that switches it on.

A file ends with an `ANNOTATION`, whose members `gen2d.plugin.Annotation` describes. The smallest one:

    from gen2d.plugin import Annotation, Field, option

    def annotate(scenes, owners, plan, value):
        return {"motion/turn": abs(scenes.instants.angle)}

    ANNOTATION = Annotation(
        options=option(False, bool, "", "rotation of each object"),
        fields={"motion/turn": Field("float32", "n T K", "rad", "absolute rotation since the first frame")},
        annotate=annotate
    )

A config selects turn.py in this folder by `annotations: {turn: true}`, and a file elsewhere by its path, as in
`annotations: {my/turn.py: true}`.
"""

from collections.abc import Mapping
from typing import Any

from gen2d.config.annotations import Annotations
from gen2d.core.errors import ConfigError
from gen2d.core.schema import Field
from gen2d.records.axes import Array
from gen2d.renderers.plan import FramePlan, RenderScene


def need_owners(annotations: Annotations) -> bool:
    """Whether any annotation needs the owners: the object that each pixel shows."""
    return any(plugin.contract.owners for plugin in annotations.wanted)


def fields(annotations: Annotations, others: Mapping[str, Field]) -> dict[str, Field]:
    """Stored fields by name: `others` and those of the annotations. Raises ConfigError if a name is declared twice."""
    return _merged_unique(others, {plugin.name: plugin.contract.fields for plugin in annotations.wanted}, "field")


def sizes(annotations: Annotations, plan: FramePlan, others: Mapping[str, int]) -> dict[str, int]:
    """Lengths of axes by letter: `others` and those of the annotations. Raises ConfigError for a repeated letter."""
    sizes_of = {plugin.name: plugin.contract.sizes(plan, plugin.options) for plugin in annotations.wanted}
    return _merged_unique(others, sizes_of, "axis")


def _merged_unique(others: Mapping[str, Any], added: Mapping[str, Mapping[str, Any]], what: str) -> dict[str, Any]:
    """`others` with the members that each annotation adds."""
    merged = dict(others)
    for name, members in added.items():
        duplicates = members.keys() & merged.keys()
        if duplicates:
            raise ConfigError(
                f"annotations.{name} has a {what} {min(duplicates)!r}, but there is one of that name already"
            )
        merged |= members
    return merged


def annotate(scenes: RenderScene, owners: Array | None, plan: FramePlan, annotations: Annotations) -> dict[str, Array]:
    """Annotations of n videos by their stored names; owners [n, T, H, W] uint8 are from `rasterizer.draw`.

    Raises ConfigError if an annotation returns other names, shapes or types than it declares.
    """
    count, frames, slots = scenes.instants.angle.shape
    arrays: dict[str, Array] = {}
    for plugin in annotations.wanted:
        returned, declared = plugin.contract.annotate(scenes, owners, plan, plugin.options), plugin.contract.fields
        lengths = {"T": frames, "K": slots, "H": plan.height, "W": plan.width}
        lengths |= plugin.contract.sizes(plan, plugin.options)
        for name in sorted(returned.keys() | declared.keys()):
            if name not in returned or name not in declared:
                verb = "declares" if name in declared else "returns"
                raise ConfigError(f"annotations.{plugin.name} {verb} {name!r}, but must declare what it returns")
            field, array = declared[name], returned[name]
            unknown = [axis for axis in field.axes.split()[1:] if not axis.isdigit() and axis not in lengths]
            if not field.per_video or unknown:
                raise ConfigError(
                    f"annotations.{plugin.name}: the axes of {name} are {field.axes!r}, but must begin with n, and the "
                    f"others be numbers or of {', '.join(lengths)}"
                )
            shape = (count, *field.shape(lengths))
            if (array.shape, array.dtype.name) != (shape, field.dtype):
                raise ConfigError(
                    f"annotations.{plugin.name}: {name} is {array.dtype.name}{[*array.shape]}, but must be as "
                    f"declared, {field.dtype}{[*shape]}"
                )
        arrays |= returned
    return arrays
