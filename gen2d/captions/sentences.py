"""Sentences about a video: an opening, and what the objects do, in words that a seeded grammar chooses."""

import dataclasses
import functools
import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

from gen2d.captions.actions import Action
from gen2d.captions.events import BOX_SIDES
from gen2d.captions.facts import VideoFacts
from gen2d.captions.references import References, number_word, plural

MAX_ACTIONS = 6  # in a caption
MAX_LISTED = 4  # objects whose size and material the first sentence names; of more it names the colour alone
MAX_PHRASES = 10  # in the first sentence; where more would be needed, objects are counted by their nouns
ENOUGH = 2  # actions of objects that can be told apart; others are mentioned only where there are fewer
GROUP = 3  # objects that do the same share a sentence from this number on
SLOW, FAST = 0.1, 0.5  # widths of the picture in a second: slower is slowly, faster is quickly

# Words for each kind of action; the seed chooses one for the video.
VERBS = {
    "starts": ("moves {way} at {number:.2g} m/s",),
    "falls": ("starts to fall", "begins to fall"),
    "peaks": ("reaches its highest point", "is at its highest"),
    "rolls": ("starts to roll {way}", "begins to roll {way}"),
    "slides": ("starts to slide {way}", "begins to slide {way}"),
    "hits": ("hits {other}", "strikes {other}", "runs into {other}"),
    "bounces": ("bounces off {other}", "rebounds from {other}"),
    "topples": ("topples to the {way}", "tips over to the {way}"),
    "swings": ("starts to swing {way}", "begins to swing {way}"),
    "tilts": ("tilts to the {way}", "tips to the {way}"),
    "sags": ("hangs lowest", "sags to its lowest point"),
    "passes": ("passes behind {other}", "moves behind {other}"),
    "vanishes": ("disappears behind {other}", "vanishes behind {other}"),
    "leaves": ("leaves the view at the {way}", "exits the view at the {way}"),
    "enters": ("enters the view from the {way}", "comes into view from the {way}"),
    "rests": ("comes to rest", "stops"),
    "stays": ("stays in place", "stays where it is"),
}
GROUP_VERBS = {
    "topples": "topple",
    "falls": "fall",
    "leaves": "leave the view",
    "rests": "come to rest",
    "stays": "stay in place",
}
# What a caption mentions first: stories, then contacts, then beginnings and ends.
PRIORITY = {"hits": 2, "bounces": 2, "falls": 2, "leaves": 1, "enters": 1, "stays": 3, "rests": 3, "starts": 4}


@dataclasses.dataclass(frozen=True)
class Grammar:
    """Choices among words, the same for the same seed."""

    seed: bytes

    def pick(self, name: str, options: Sequence[str]) -> str:
        """One of the options; `name` says what is chosen."""
        digest = hashlib.sha256(self.seed + name.encode()).digest()
        return options[int.from_bytes(digest[:8], "little") % len(options)]


def grammar_of(facts: VideoFacts) -> Grammar:
    """Grammar of a video, seeded by its initial state."""
    start = (facts.columns[f"states/{name}"][0].tobytes() for name in ("position", "velocity"))
    return Grammar(hashlib.sha256(b"".join(start)).digest())


@dataclasses.dataclass(frozen=True, eq=False)
class Story:
    """Sentences about a video."""

    facts: VideoFacts
    actions: Sequence[Action]
    grammar: Grammar
    references: References

    @functools.cached_property
    def decimals(self) -> int:
        """Decimals of times."""
        return max(2, math.ceil(math.log10(self.facts.video.fps)))

    def long(self, limit: int) -> str:
        """Caption of several sentences, of at most `limit` bytes."""
        ranked = self._ranked()
        texts = (self._long_of(ranked[:shown]) for shown in range(min(MAX_ACTIONS, len(ranked)), -1, -1))
        fitting = (text for text in texts if len(text.encode()) <= limit)
        return next(fitting, "")

    def short(self, limit: int) -> str:
        """Caption of one sentence without times, of at most `limit` bytes; "" if none is so short."""
        texts = [f"{self._sentence(action)}." for action in self._ranked()[:1]]
        return next(
            (text[0].upper() + text[1:] for text in [*texts, self.opening()] if len(text.encode()) <= limit), ""
        )

    # ---- The first sentence

    def opening(self) -> str:
        """First sentence: the objects, the box and gravity."""
        facts = self.facts
        things = self._things()
        extras = [facts.walls.get(slot, noun) for slot, noun in facts.nouns.items() if slot not in facts.moving]
        extras = [noun for noun in extras if noun != "pin" and not (facts.boxed and noun in (*BOX_SIDES, "wall"))]
        where = " in a box" if facts.boxed else ""
        where += f" with {count_phrase(extras)}" if extras else ""
        pinned = [s for s in facts.moving if facts.nouns[s] != "link" and not facts.chain_of(s) and facts.pins_of(s)]
        where += " on a pin" if any(facts.nouns[pin] == "pin" for s in pinned for pin in facts.pins_of(s)) else ""
        where += gravity_phrase(facts)
        style = self.grammar.pick("opening", ("plain", "there"))
        one = len(things) == 1 and not things[0].startswith(tuple(number_word(n) for n in range(2, 13)))
        verb = "There is" if one else "There are"
        text = f"{verb} {enumeration(things)}{where}." if style == "there" else f"{enumeration(things)}{where}."
        return text[0].upper() + text[1:]

    def _things(self) -> list[str]:
        facts, moving = self.facts, self.facts.moving
        chains = {tuple(facts.chain_of(slot)) for slot in moving if facts.nouns[slot] == "link"}
        things = []
        for chain in sorted(chains):
            pins = len(facts.pins_of(chain[0]))
            held = {1: " on a pin", 2: " between two pins"}.get(pins, "")
            things.append(f"a chain of {number_word(len(chain))} links{held}")
        others = [slot for slot in moving if facts.nouns[slot] != "link"]
        colors, sizes, materials = self.references.colors, self.references.sizes, self.references.materials
        words = [[sizes[s], colors[s], materials[s], facts.nouns[s]] for s in others]
        words = words if len(others) <= MAX_LISTED else [[color, noun] for _, color, _, noun in words]
        phrases = Counter(" ".join(word for word in row if word) for row in words)
        if len(phrases) > MAX_PHRASES:
            phrases = Counter(facts.nouns[slot] for slot in others)
        return things + [_counted(phrase, n) for phrase, n in phrases.items()]

    # ---- What the objects do

    def _ranked(self) -> list[Action]:
        """Actions in the order in which they are worth mentioning, with one for those of a group."""
        actions = self._grouped()
        seen: Counter[Any] = Counter()
        ranked = []
        for action in actions:  # another kind, or another pair, is worth more than the same again
            same = action.kind, action.slot, action.other
            rank = seen[action.kind] + 2 * seen[same]
            ranked.append(((not self._unique(action), rank, PRIORITY.get(action.kind, 0)), action))
            seen.update((action.kind, same))
        ranked.sort(key=lambda pair: pair[0])
        clear = sum(not rank[0] for rank, _ in ranked)
        return [action for _, action in ranked[: clear if clear >= ENOUGH else None]]

    def _unique(self, action: Action) -> bool:
        refs = self.references.all
        return action.way == "group" or all(refs[s].unique for s in (action.slot, action.other) if s >= 0)

    def _grouped(self) -> list[Action]:
        """Actions, with the first alone, marked as a group, where three objects with the same noun do the same.

        What reaches its highest point falls from there, so it counts among those that fall.
        """
        groups: dict[tuple[str, str], list[Action]] = {}
        for action in self.actions:
            kind = "falls" if action.kind == "peaks" else action.kind
            if kind in GROUP_VERBS:
                groups.setdefault((kind, self.facts.nouns[action.slot]), []).append(action)
        kept = []
        for action in self.actions:
            group = groups.get((action.kind, self.facts.nouns[action.slot]), [])
            slots = len({a.slot for a in group})
            if slots < GROUP:
                kept.append(action)
            elif next(a for a in group if a.kind == action.kind) is action:
                kept.append(action._replace(way="group", number=slots, time=group[0].time))
        return kept

    def _long_of(self, actions: Sequence[Action]) -> str:
        lines, last = [self.opening()], -1
        for action in sorted(actions, key=lambda action: action.time):
            if action.way == "group":
                first = "" if action.kind == "stays" else f", the first {self._at(action)}"
                lines.append(f"{self._sentence(action)}{first}.")
                last = -1
            elif action.slot == last:
                lines[-1] = (
                    f"{lines[-1][:-1]}, {self.grammar.pick('then', ('then', 'and then'))} {self._clause(action)}."
                )
            else:
                lines.append(f"{self.references.all[action.slot].text} {self._clause(action)}.")
                last = action.slot
        hits = sum(action.kind in ("hits", "bounces") for action in actions)
        more = len(self.facts.hits) - hits
        if more > 0:
            amount = f"at least {more}" if self.facts.missed else f"{more}"
            lines.append(f"there {'is' if more == 1 else 'are'} {amount} more hit{'s' if more > 1 else ''}.")
        return " ".join(line[0].upper() + line[1:] for line in lines)

    def _at(self, action: Action) -> str:
        return f"{self.grammar.pick('at', ('at', 'after'))} {action.time:.{self.decimals}f} s"

    def _clause(self, action: Action) -> str:
        """Verb, object and time of an action."""
        if action.kind == "starts":
            return f"first {self.verb(action)}"
        if action.kind == "stays":
            return self.verb(action)
        head, _, change = self.verb(action).partition(", ")
        return f"{head} {self._at(action)}" + (f", {change}" if change else "")

    def _sentence(self, action: Action) -> str:
        """An action with its subject, without its time."""
        if action.way == "group":
            noun, count = self.facts.nouns[action.slot], int(action.number)
            total = sum(self.facts.nouns[slot] == noun for slot in self.facts.moving)
            some = (
                f"all {number_word(total)}" if count == total else f"{number_word(count)} of the {number_word(total)}"
            )
            unknown = self.facts.missed and action.kind == "falls" and count < total
            return f"{'at least ' if unknown else ''}{some} {plural(noun)} {GROUP_VERBS[action.kind]}"
        return f"{self.references.all[action.slot].text} {self.verb(action)}"

    def verb(self, action: Action) -> str:
        """Verb and object of an action, in the words of the video's grammar."""
        way, change = action.way, ""
        if action.kind in ("rolls", "slides"):
            way, comma, change = action.way.partition(", ")
            on = self.references.all[action.other].text
            way, change = f"{way} on {on}", comma + change
        if action.kind == "starts":
            width = self.facts.video.width / float(self.facts.columns["camera/scale"][0])
            pace = action.number / width
            way = f"{'slowly ' if pace < SLOW else 'quickly ' if pace > FAST else ''}{way}"
        other = self.references.all[action.other].text if action.other >= 0 else ""
        pattern = self.grammar.pick(action.kind, VERBS[action.kind])
        return f"{pattern.format(way=way, other=other, number=action.number)}".strip() + change


def _counted(phrase: str, count: int) -> str:
    """A phrase with its number, such as: two red balls."""
    if count == 1:
        return f"{'an' if phrase[0] in 'aeiou' else 'a'} {phrase}"
    head, _, noun = phrase.rpartition(" ")
    return " ".join(part for part in (number_word(count), head, plural(noun)) if part)


def enumeration(parts: Sequence[str]) -> str:
    """Phrases joined by commas, and by 'and' before the last."""
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if parts[1:] else parts or ["nothing that moves"])


def count_phrase(nouns: Sequence[str]) -> str:
    """Nouns with their counts, such as: two balls and a block."""
    return enumeration([_counted(noun, count) for noun, count in Counter(nouns).items()])


def gravity_phrase(facts: VideoFacts) -> str:
    """Phrase for the direction of gravity, for the end of the first sentence."""
    x, y = facts.gravity.tolist()
    if not (x or y):
        return ""
    if abs(y) >= abs(x):
        return " under gravity" if y < 0 else " under gravity upwards"
    return f" under gravity to the {'right' if x > 0 else 'left'}"
