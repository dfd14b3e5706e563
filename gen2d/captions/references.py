"""Phrases that tell the objects of a video apart by what can be seen in its first frame.

A phrase is the shortest of those that fit one object alone, from its colour, size, material and place. The place is
that in frame 0: a side of the picture, or a rank such as 'the second ball from the left'.
"""

import dataclasses
import functools
from collections.abc import Iterator, Mapping

import numpy as np

from gen2d.captions.colors import DISTINCT, cielab, color_word
from gen2d.captions.facts import VideoFacts

NUMBERS = ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"]
ORDINALS = ["", "second ", "third ", "fourth ", "fifth ", "sixth ", "seventh ", "eighth ", "ninth ", "tenth "]
EXTREMES = {"left": "leftmost", "right": "rightmost", "top": "highest", "bottom": "lowest"}  # by side
SIZES_DIFFER, SIZES_AGREE = 1.5, 1.2  # ratios of sizes: of large to small objects, and within either kind
SIDE, SIDE_GAP = 1 / 3, 0.08  # of the picture: what is on a side of it, and how far from there others must be
RANK_GAP = 0.02  # of the picture, between successive ranks up to the one after an object's
SIDES = {"left": (0, 1), "right": (0, -1), "top": (1, 1), "bottom": (1, -1)}  # axis of pixels, sign of the rank
PLACES = {"left": "on the left", "right": "on the right", "top": "at the top", "bottom": "at the bottom"}
PLURALS = {"shelf": "shelves"}
MATERIALS = {"wood": "wooden"}  # adjectives that differ from the stored name


@dataclasses.dataclass(frozen=True)
class Reference:
    """A phrase for an object, and the program of the questions that selects the object."""

    text: str
    program: tuple[str, ...]
    unique: bool  # whether the phrase fits no other object


def plural(noun: str) -> str:
    """Plural of a noun."""
    return PLURALS.get(noun, f"{noun}s")


def number_word(count: int) -> str:
    """Number in words up to twelve, and in digits above."""
    return NUMBERS[count] if count < len(NUMBERS) else f"{count}"


def material_word(columns: Mapping[str, np.ndarray], slot: int) -> str:
    """Adjective for the stored material of an object (`objects/material_name`); "" if none is stored."""
    if "objects/material_name" not in columns:
        return ""
    name = bytes(columns["objects/material_name"][slot]).decode()
    return MATERIALS.get(name, name)


@dataclasses.dataclass(frozen=True, eq=False)
class References:
    """Phrases for the objects of a video."""

    facts: VideoFacts

    @functools.cached_property
    def colors(self) -> dict[int, str]:
        """Word for the colour of each moving object; "" where no word is near."""
        return {slot: color_word(self.facts.columns, slot) for slot in self.facts.moving}

    @functools.cached_property
    def materials(self) -> dict[int, str]:
        """Adjective for the material of each moving object; "" if none is stored."""
        return {slot: material_word(self.facts.columns, slot) for slot in self.facts.moving}

    @functools.cached_property
    def sizes(self) -> dict[int, str]:
        """Each moving object's size among those with its noun: small, large or ""."""
        words = dict.fromkeys(self.facts.moving, "")
        for noun in {self.facts.nouns[slot] for slot in self.facts.moving}:
            slots = [slot for slot in self.facts.moving if self.facts.nouns[slot] == noun]
            reach = self.facts.reach[slots]
            if reach.max() >= SIZES_DIFFER * reach.min():
                words |= {s: "small" for s, r in zip(slots, reach, strict=True) if r <= SIZES_AGREE * reach.min()}
                words |= {s: "large" for s, r in zip(slots, reach, strict=True) if r >= reach.max() / SIZES_AGREE}
        return words

    @functools.cached_property
    def _lab(self) -> np.ndarray:
        return cielab(self.facts.columns["objects/color"])

    def alike(self, slot: int, color: bool = False, size: bool = False, material: bool = False) -> list[int]:
        """Slots with the noun of a moving object, and with its colour, size and material where these are asked for.

        A colour that hardly differs from the object's counts as its colour, whatever its word is.
        """
        facts = self.facts
        slots = [other for other in facts.moving if facts.nouns[other] == facts.nouns[slot]]
        if color:
            near = np.linalg.norm(self._lab - self._lab[slot], axis=-1) < DISTINCT
            slots = [other for other in slots if near[other] or self.colors[other] == self.colors[slot]]
        if size:
            slots = [other for other in slots if self.sizes[other] == self.sizes[slot]]
        return [other for other in slots if not material or self.materials[other] == self.materials[slot]]

    @functools.cached_property
    def all(self) -> dict[int, Reference]:
        """Reference of each object that is present, by slot."""
        moving = set(self.facts.moving)
        return {slot: self._moving(slot) if slot in moving else self._static(slot) for slot in self.facts.nouns}

    def _moving(self, slot: int) -> Reference:
        noun = self.facts.nouns[slot]
        if noun == "link":
            alone = len(self.facts.chain_of(slot)) == sum(n == "link" for n in self.facts.nouns.values())
            return Reference("the chain", ("objects", "link", "filter_shape"), alone)
        for text, program, unique in self._candidates(slot):
            if unique:
                return Reference(f"the {text}", program if program[-1] == "rank" else (*program, "unique"), True)
        same, words = self.alike(slot, color=bool(self.colors[slot])), self.colors[slot]
        text = f"{words} {plural(noun)}".strip()
        return Reference(f"one of {number_word(len(same))} {text}", ("objects",), False)

    def _candidates(self, slot: int) -> Iterator[tuple[str, tuple[str, ...], bool]]:
        """Phrases for a moving object from the shortest on, with their programs, and whether they fit it alone."""
        noun = self.facts.nouns[slot]
        words = {"color": self.colors[slot], "size": self.sizes[slot], "material": self.materials[slot]}
        base = ("objects", noun, "filter_shape")

        def described(*names: str) -> tuple[str, tuple[str, ...], list[int]]:
            program = base
            for name in names:
                program = (*program, words[name], f"filter_{name}")
            order = [name for name in ("size", "color", "material") if name in names]  # as in English
            text = " ".join([*(words[name] for name in order), noun])
            return text, program, self.alike(slot, **dict.fromkeys(names, True))

        choices = [(), ("color",), ("size",), ("material",), ("color", "size"), ("color", "material")]
        usable = [described(*names) for names in choices if all(words[name] for name in names)]
        for text, program, slots in usable:
            yield text, program, slots == [slot]
        for text, program, slots in usable:
            for side in SIDES:
                if self.on_side(slot, side, slots):
                    yield f"{text} {PLACES[side]}", (*program, side, "filter_place"), True
        for text, program, slots in usable:
            if "filter_color" in program and any(self.colors[other] != self.colors[slot] for other in slots):
                continue  # a rank counts objects by their word
            for rank, side in self.ranks(slot, slots):
                if rank == 0:
                    yield f"{EXTREMES[side]} {text}", (*program, "0", side, "rank"), True
                else:
                    yield f"{ORDINALS[rank]}{text} from the {side}", (*program, f"{rank}", side, "rank"), True

    def without_color(self, slot: int) -> list[tuple[str, tuple[str, ...]]]:
        """Phrases, without 'the', and programs for a moving object that do not name its colour and fit it alone."""
        phrases = [(text, program) for text, program, unique in self._candidates(slot) if unique]
        plain = [(text, program) for text, program in phrases if "filter_color" not in program]
        return [(text, program if program[-1] == "rank" else (*program, "unique")) for text, program in plain]

    def on_side(self, slot: int, side: str, slots: list[int]) -> bool:
        """Whether an object alone, of these, is on a side of frame 0, and clearly so."""
        axis, sign = SIDES[side]
        extent = (self.facts.video.width, self.facts.video.height)[axis]
        along = {other: self.facts.start[other, axis] / extent for other in slots}
        along = along if sign > 0 else {other: 1 - x for other, x in along.items()}
        others = [x for other, x in along.items() if other != slot]
        seen = self.facts.seen_at_start.issuperset(slots)
        return seen and along[slot] <= SIDE and min(others, default=1) >= max(SIDE, along[slot] + SIDE_GAP)

    def ranks(self, slot: int, slots: list[int]) -> Iterator[tuple[int, str]]:
        """Ranks of an object among these, the lowest first, from sides from which it and all before it are apart."""
        if len(slots) < 2 or not self.facts.seen_at_start.issuperset(slots):
            return
        ranked = []
        for side, (axis, sign) in SIDES.items():
            along = sign * self.facts.start[:, axis] / (self.facts.video.width, self.facts.video.height)[axis]
            order = sorted(slots, key=lambda other: along[other])
            rank = order.index(slot)
            gap = np.diff(along[order[: rank + 2]]).min()
            if gap >= RANK_GAP and rank < len(ORDINALS):
                ranked.append((rank, -gap, side))
        yield from ((rank, side) for rank, _, side in sorted(ranked))

    def _static(self, slot: int) -> Reference:
        facts = self.facts
        name = facts.walls.get(slot, facts.nouns[slot])
        same = [s for s in facts.nouns if s not in facts.moving and facts.walls.get(s, facts.nouns[s]) == name]
        program = ("fixtures", name, "filter_shape")
        if len(same) == 1:
            return Reference(f"the {name}", (*program, "unique"), True)
        if name not in ("peg", "pin"):
            for rank, side in self.ranks(slot, same):
                text = f"{ORDINALS[rank]}{name} from the {side}" if rank else f"{EXTREMES[side]} {name}"
                return Reference(f"the {text}", (*program, f"{rank}", side, "rank"), True)
        return Reference(f"one of {number_word(len(same))} {plural(name)}", program, False)
