"""Filters of videos by their values, such as "factors/gravity[1] < -5 and not out_of_distribution".

    filter      = conjunction { "or" conjunction }
    conjunction = negation { "and" negation }
    negation    = "not" negation | "(" filter ")" | comparison
    comparison  = value { sign value }         a chain, too, such as 0 < factors/radius[0] < 1; or a bool field alone
    sign        = "<" | "<=" | ">" | ">=" | "==" | "!="
    value       = FIELD [ "[" index { "," index } "]" ] | number | "true" | "false" | text

Text is in quotes, or a word. A field with codes may be compared with their names. FIELD_x and FIELD_y are the
components of a field of two numbers per video.
"""

import operator
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, NoReturn

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.core.schema import Field
from gen2d.loading.fields import suggestion
from gen2d.loading.protocols import Batch

COMPARISONS: dict[str, Callable[[Any, Any], Any]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
}
EXAMPLE = "'factors/balls > 3 and factors/gravity[1] < -5'"
DEEPEST = 50  # parentheses and negations in one another
_TOKEN = re.compile(
    r"""\s*(?:(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?![\w/.])|[+-]?inf(?![\w/.-]))
    |(?P<word>[A-Za-z_][\w.-]*(?:/[\w.-]+)*)|(?P<text>"[^"]*"|'[^']*')|(?P<sign><=|>=|==|!=|[<>()\[\],]))""",
    re.VERBOSE,
)
Evaluate = Callable[[Batch], Any]


class Filter(NamedTuple):
    """Parsed filter: the stored fields that it reads, and the function from their values [n, ...] to bool [n]."""

    fields: tuple[str, ...]
    evaluate: Evaluate


class _Value(NamedTuple):
    """Value of a comparison: its field, None for a constant, and how it is computed."""

    field: Field | None
    evaluate: Evaluate
    constant: Any = None


def parse_filter(
    text: str, fields: Mapping[str, Field], sizes: Mapping[str, int], source: str, name: str = "filter"
) -> Filter:
    """Filter of videos with these fields and sizes of axes.

    Error messages call it `name` and the dataset `source`. Raises ConfigError if it is no filter, or names a field that
    has no such value.
    """
    return _Parser(text, fields, sizes, source, name).parse()


class _Parser:
    def __init__(
        self, text: str, fields: Mapping[str, Field], sizes: Mapping[str, int], source: str, name: str
    ) -> None:
        if not isinstance(text, str):
            raise ConfigError(f"{name} is {text!r:.80}, but must be a text such as {EXAMPLE}")
        self._text, self._fields, self._sizes, self._source, self._name = text, fields, sizes, source, name
        self._used: dict[str, None] = {}
        self._tokens, self._next, self._depth = self._split(), 0, 0

    def parse(self) -> Filter:
        evaluate = self._filter()
        if self._kind:
            self._fail(f"{self._token} stands where the filter should end, or go on with 'and' or 'or'")
        return Filter(tuple(self._used), evaluate)

    def _fail(self, reason: str) -> NoReturn:
        raise ConfigError(f"{self._name} is {self._text!r}, but {reason}")

    def _split(self) -> list[tuple[str, str]]:
        tokens, place, text = [], 0, self._text.rstrip()
        while place < len(text):
            match = _TOKEN.match(text, place)
            if match is None:
                hint = ": say == for equality" if text[place:].lstrip().startswith("=") else f", as {EXAMPLE} is"
                self._fail(f"must be made of fields, numbers, comparisons, and, or and not{hint}")
            assert match.lastgroup
            tokens.append((match.lastgroup, match[match.lastgroup]))
            place = match.end()
        return tokens

    # ---- Tokens

    @property
    def _kind(self) -> str:
        return self._tokens[self._next][0] if self._next < len(self._tokens) else ""

    @property
    def _token(self) -> str:
        return self._tokens[self._next][1] if self._next < len(self._tokens) else "nothing"

    def _take(self, *tokens: str) -> bool:
        """Whether one of these comes next; it is consumed."""
        is_next = self._kind in ("word", "sign") and self._token in tokens
        self._next += is_next
        return is_next

    # ---- Grammar

    def _filter(self) -> Evaluate:
        parts = [self._conjunction()]
        while self._take("or"):
            parts.append(self._conjunction())
        return parts[0] if len(parts) == 1 else lambda batch: np.logical_or.reduce([part(batch) for part in parts])

    def _conjunction(self) -> Evaluate:
        parts = [self._negation()]
        while self._take("and"):
            parts.append(self._negation())
        return parts[0] if len(parts) == 1 else lambda batch: np.logical_and.reduce([part(batch) for part in parts])

    def _negation(self) -> Evaluate:
        self._depth += 1
        if self._depth > DEEPEST:
            self._fail(f"must have at most {DEEPEST} parentheses and negations in one another")
        try:
            if self._take("not"):
                inner = self._negation()
                return lambda batch: np.logical_not(inner(batch))
            if self._take("("):
                inner = self._filter()
                if not self._take(")"):
                    self._fail("a parenthesis is not closed")
                return inner
            return self._comparison()
        finally:
            self._depth -= 1

    def _comparison(self) -> Evaluate:
        values, signs = [self._value()], []
        while self._kind == "sign" and self._token in COMPARISONS:
            signs.append(self._token)
            self._next += 1
            values.append(self._value())
        if not signs:
            value = values[0]
            if value.field is None or value.field.dtype != "bool":
                self._fail(f"must compare values with {', '.join(COMPARISONS)}, as {EXAMPLE} does")
            return value.evaluate
        parts = [self._pair(*pair) for pair in zip(values, signs, values[1:], strict=False)]
        return parts[0] if len(parts) == 1 else lambda batch: np.logical_and.reduce([part(batch) for part in parts])

    def _pair(self, left: _Value, sign: str, right: _Value) -> Evaluate:
        compare = COMPARISONS[sign]
        if left.field is None and right.field is None:
            self._fail(f"compares {left.constant!r} with {right.constant!r}: one of them must be a field")
        one, other = self._as_other(left, right), self._as_other(right, left)
        return lambda batch: compare(one(batch), other(batch))

    def _as_other(self, value: _Value, other: _Value) -> Evaluate:
        """The value in the type of what it is compared with. Raises ConfigError if it has none."""
        field, constant = other.field, value.constant
        if field is None or value.field is not None:
            if field is not None and value.field is not None and field.is_text != value.field.is_text:
                self._fail("compares a text with a number")
            return value.evaluate
        if field.is_text:
            if not isinstance(constant, str):
                self._fail(f"compares a text with the number {constant}: put it in quotes")
            encoded = np.bytes_(constant.encode())
            return lambda batch: encoded
        if isinstance(constant, str):
            codes = {meaning: code for code, meaning in field.codes.items()}
            if constant not in codes:
                allowed = f"one of {', '.join(codes)}" if codes else "a number or a field"
                self._fail(f"compares a number with {constant!r}, which must be {allowed}")
            return lambda batch: codes[constant]
        return value.evaluate

    def _value(self) -> _Value:
        kind, token = self._kind, self._token
        if kind not in ("number", "word", "text") or (kind == "word" and token in ("and", "or", "not")):
            self._fail(f"{token} stands where a field or a number should, as in {EXAMPLE}")
        self._next += 1
        if kind == "number":
            return _constant(float(token) if re.search(r"[.eEn]", token) else int(token))
        if kind == "text":
            return _constant(token[1:-1])
        if token.lower() in ("true", "false"):
            return _constant(token.lower() == "true")
        name, index = self._component(token)
        if name not in self._fields:
            is_text = "/" not in name and self._next >= 2 and self._tokens[self._next - 2][1] in COMPARISONS
            if is_text:  # a word after a sign; as a field it would be written with its group
                return _constant(token)
            raise ConfigError(f"{self._source} has no field {name!r}{suggestion(name, self._fields)}")
        self._used[name] = None
        field = self._fields[name]
        self._check_index(name, field, index)
        return _Value(field, lambda batch: batch[name][(slice(None), *index)])

    def _component(self, word: str) -> tuple[str, tuple[int, ...]]:
        """Name of a field, and the indices after it."""
        if self._take("["):
            index = [self._index()]
            while self._take(","):
                index.append(self._index())
            if not self._take("]"):
                self._fail("a bracket is not closed")
            return word, tuple(index)
        field = self._fields.get(word[:-2])
        if word not in self._fields and word[-2:] in ("_x", "_y") and field is not None and field.axes == "n 2":
            return word[:-2], (int(word.endswith("_y")),)
        return word, ()

    def _index(self) -> int:
        if self._kind != "number" or not self._token.isdecimal():
            self._fail(f"an index must be a whole number, 0 or more, not {self._token}")
        self._next += 1
        return int(self._tokens[self._next - 1][1])

    def _check_index(self, name: str, field: Field, index: tuple[int, ...]) -> None:
        if field.is_image or not field.per_video:
            why = "an image" if field.is_image else "the same for all videos"
            self._fail(f"{name} is {why}: name a field with few values per video")
        shape = field.shape(self._sizes)
        if len(index) == len(shape) and all(i < size for i, size in zip(index, shape, strict=True)):
            return
        if not shape:
            self._fail(f"{name} has one value per video, and takes no index")
        below = " x ".join(map(str, shape))
        self._fail(f"{name} has {below} values per video: choose one, such as {name}[{', '.join('0' * len(shape))}]")


def _constant(value: Any) -> _Value:
    return _Value(None, lambda batch: value, value)
