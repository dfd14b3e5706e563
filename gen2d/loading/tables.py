"""Tables of per-video fields, and the text and HTML that describe a dataset."""

import html
import importlib
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.core.schema import Field
from gen2d.loading.fields import suggestion
from gen2d.loading.protocols import Batch

PER_OBJECT = {*"TKHWCJVPB"}  # axes of frames, object slots, pixels, contacts, joints, vertices, points and bits
SHOWN = 20  # fields of a dataset's text


def table_fields(fields: Mapping[str, Field], names: Sequence[str] | str | None, source: str) -> tuple[str, ...]:
    """Names of the fields of a table: those per video, without frames or slots, if `names` is None.

    Raises ConfigError for a field that is an image, the same for all videos, or not there.
    """
    if names is None:
        per_video = (name for name, field in fields.items() if field.per_video)
        first = sorted(per_video, key=lambda name: (name != "index", not name.startswith("factors/"), name))
        return tuple(name for name in first if not {*fields[name].axes.split()} & PER_OBJECT)
    chosen = (names,) if isinstance(names, str) else tuple(names)
    for name in chosen:
        if name not in fields:
            raise ConfigError(f"{source} has no field {name!r}{suggestion(name, fields)}")
        if fields[name].is_image or not fields[name].per_video:
            why = "an image" if fields[name].is_image else "the same for all videos"
            raise ConfigError(f"{name} is {why}, so it cannot be a column of a table")
    return tuple(dict.fromkeys(chosen))


def columns(values: Batch, fields: Mapping[str, Field]) -> dict[str, Any]:
    """Columns of a table: arrays [n], or lists of texts; NAME[i] and NAME[i, j] for each value of an array."""
    found: dict[str, Any] = {}
    for name, array in values.items():
        for index in itertools.product(*map(range, array.shape[1:])):
            column = array[(slice(None), *index)]
            label = f"{name}[{', '.join(map(str, index))}]" if index else name
            if fields[name].is_text:
                found[label] = [value.rstrip(b"\0").decode("utf-8", "replace") for value in column.tolist()]
            else:
                found[label] = np.ascontiguousarray(column)
    return found


def optional_package(name: str, method: str) -> Any:
    """The imported package. Raises ModuleNotFoundError with one sentence if it is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        message = f"{method} needs {name}, which is not installed: pip install {name}"
        raise ModuleNotFoundError(message, name=name) from None


def field_rows(fields: Mapping[str, Field]) -> list[tuple[str, str, str, str, str]]:
    """Name, dtype, axes, unit and meaning of each field."""
    return [(name, each.dtype, each.axes, each.unit, each.meaning) for name, each in fields.items()]


def describe_text(title: str, lines: Iterable[str], fields: Mapping[str, Field]) -> str:
    """Title, lines and a table of the first fields, as plain text."""
    rows = [row[:4] for row in field_rows(fields)][:SHOWN]
    widths = [max(len(row[i]) for row in rows) for i in range(4)] if rows else []
    table = ["  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    more = [f"  and {len(fields) - SHOWN} more fields"] if len(fields) > SHOWN else []
    return "\n".join([title, *(f"  {line}" for line in lines), *(row.rstrip() for row in table), *more])


def describe_html(title: str, lines: Iterable[str], fields: Mapping[str, Field]) -> str:
    """Title, lines and a table of the fields, as HTML in which every text of the dataset is escaped."""
    head = "".join(f"<th style='text-align:left'>{name}</th>" for name in ("field", "dtype", "axes", "unit", "meaning"))
    cells = (
        "".join(f"<td style='text-align:left'>{html.escape(cell)}</td>" for cell in row) for row in field_rows(fields)
    )
    body = "".join(f"<tr>{row}</tr>" for row in cells)
    about = "<br>".join(html.escape(line) for line in lines)
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f"<div><b>{html.escape(title)}</b><br>{about}{table}</div>"
