"""Questions about a video, each with a program and the answer that the program computes from the stored truth.

A program is a list of words in postfix order, as in CLEVRER: values are pushed on a stack, operations take theirs from
it. `run` executes a program. Descriptive questions are about the whole video; predictive ones about what happens after
a given time, from the frames up to it; counterfactual ones (of matched sets) about another video of the set.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from gen2d.captions.actions import Action
from gen2d.captions.events import REST_SPEED
from gen2d.captions.references import Reference, plural
from gen2d.captions.sentences import Story
from gen2d.core.enums import POLYGON

QUESTIONS = 6  # stored for a video, at most: one of each template
YES_NO = ("no", "yes")
EVENTS = {  # of programs, with the kinds of actions
    "hit": ("hits", "bounces"),
    "leave": ("leaves",),
    "topple": ("topples",),
    "rest": ("rests",),
    "stay": ("stays",),
}
VERBS = {"leave": "leave the view", "topple": "topple", "rest": "come to rest", "stay": "stay in place"}
OBSERVED = (0.3, 0.4, 0.5, 0.6)  # shares of the video after which a prediction may begin


class Question(NamedTuple):
    """A question with its answer."""

    type: str  # descriptive, predictive or counterfactual
    template: str  # questions of one template have answers of one kind
    question: str
    answer: str
    program: tuple[str, ...]

    @property
    def json(self) -> dict[str, Any]:
        """The question as stored."""
        return {**self._asdict(), "program": list(self.program)}


def questions_json(questions: Sequence[Question], width: int) -> str:
    """JSON list of the first questions, as many as fit in `width` bytes."""
    texts: list[str] = []
    for question in questions:
        text = json.dumps(question.json, separators=(",", ":"))
        if 2 + sum(len(each) + 1 for each in [*texts, text]) - 1 > width:
            break
        texts.append(text)
    return f"[{','.join(texts)}]"


# ---- Programs


def run(program: Sequence[str], story: Story, members: Mapping[int, Story] | None = None) -> str:
    """Answer of a program about a video; `members` are the other videos of its set, by number.

    Raises ValueError if it is not a program, or if an object that it names is not one alone.
    """
    stack: list[Any] = []
    for word in program:
        if word == "member_events":
            stack.append(list((members or {})[int(stack.pop())].actions))
            continue
        operation = OPERATIONS.get(word)
        if operation is None:
            stack.append(word)
            continue
        count, function = operation
        if len(stack) < count:
            raise ValueError(f"{word} needs {count} values on the stack, which has {len(stack)}")
        values = [stack.pop() for _ in range(count)][::-1]
        stack.append(function(story, *values))
    if len(stack) != 1:
        raise ValueError(f"a program must leave one value, but left {len(stack)}")
    return stack[0]


def _name(story: Story, slot: int) -> str:
    return story.facts.walls.get(slot, story.facts.nouns[slot])


def _static(story: Story) -> list[int]:
    return [slot for slot in story.facts.nouns if slot not in story.facts.moving]


def _only(slots: Sequence[int]) -> int:
    if len(slots) != 1:
        raise ValueError(f"{len(slots)} objects are meant, but must be one")
    return slots[0]


def _rank(story: Story, slots: list[int], number: str, side: str) -> int:
    at = [slot for slot in slots if (int(number), side) in story.references.ranks(slot, slots)]
    return _only(at)


def _involved(events: list[Action], slot: int) -> list[Action]:
    return [event for event in events if slot in (event.slot, event.other)]


# Each operation with the number of its values.
OPERATIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    "objects": (0, lambda story: list(story.facts.moving)),
    "fixtures": (0, _static),
    "events": (0, lambda story: list(story.actions)),
    "filter_shape": (2, lambda story, slots, noun: [s for s in slots if _name(story, s) == noun]),
    "filter_color": (2, lambda story, slots, word: [s for s in slots if story.references.colors[s] == word]),
    "filter_size": (2, lambda story, slots, word: [s for s in slots if story.references.sizes[s] == word]),
    "filter_material": (2, lambda story, slots, word: [s for s in slots if story.references.materials[s] == word]),
    "filter_place": (2, lambda story, slots, side: [s for s in slots if story.references.on_side(s, side, slots)]),
    "rank": (3, _rank),
    "unique": (1, lambda story, slots: _only(slots)),
    "filter_event": (2, lambda story, events, kind: [e for e in events if e.kind in EVENTS[kind]]),
    "filter_object": (2, lambda story, events, slot: _involved(events, slot)),
    "filter_after": (2, lambda story, events, time: [e for e in events if e.time > float(time)]),
    "subjects": (1, lambda story, events: sorted({event.slot for event in events})),
    "first": (1, lambda story, events: events[0]),
    "partner": (2, lambda story, event, slot: event.other if event.slot == slot else event.slot),
    "describe": (1, lambda story, slot: story.references.all[slot].text.removeprefix("the ")),
    "query_color": (1, lambda story, slot: story.references.colors[slot]),
    "count": (1, lambda story, things: f"{len(things)}"),
    "exist": (1, lambda story, things: YES_NO[bool(things)]),
}


# ---- Questions of one video


def questions_of(story: Story) -> list[Question]:
    """Questions about a video, one of each template where it has one, in an order that the seed decides."""
    templates = (_count, _color, _happens, _hits, _first_hit, _predict)
    found = [question for template in templates for question in _chosen(template, story)]
    order = sorted(range(len(found)), key=lambda i: story.grammar.pick(f"order {found[i].template}", ORDER))
    return [found[i] for i in order]


ORDER = [f"{i:03d}" for i in range(1000)]
Candidate = tuple[str, str, tuple[str, ...]]  # an answer, a question, its program
Template = Callable[[Story], Iterator[Candidate]]


def _chosen(template: Template, story: Story) -> Iterator[Question]:
    """A question of a template: first the answer is chosen, then one of the questions that have it.

    A question with yes or no is asked only of videos that have questions with either answer, so both are as likely.
    """
    name = template.__name__.strip("_")
    candidates = list(template(story))
    answers = sorted({answer for answer, _, _ in candidates})
    if not answers or answers in (["no"], ["yes"]):
        return
    answer = story.grammar.pick(f"answer {name}", answers)
    matching = [candidate for candidate in candidates if candidate[0] == answer]
    _, question, program = matching[int(story.grammar.pick(f"question {name}", ORDER)) % len(matching)]
    kind = "predictive" if template is _predict else "descriptive"
    yield Question(kind, name, f"{question[0].upper()}{question[1:]}?", run(program, story), program)


def _named(story: Story) -> dict[int, Reference]:
    """Moving objects with a phrase of their own."""
    refs = story.references.all
    return {slot: refs[slot] for slot in story.facts.moving if refs[slot].unique and refs[slot].text != "the chain"}


def _count(story: Story) -> Iterator[Candidate]:
    """How many objects there are, and how many of them do something."""
    nouns = sorted({story.facts.nouns[slot] for slot in story.facts.moving})
    for noun in nouns:
        shape, slots = (noun, "filter_shape"), {s for s in story.facts.moving if story.facts.nouns[s] == noun}
        yield f"{len(slots)}", f"how many {plural(noun)} are there", ("objects", *shape, "count")
        for kind, verb in VERBS.items():
            doing = {action.slot for action in story.actions if action.kind in EVENTS[kind]} & slots
            if doing or (kind == "topple" and _can_topple(story, noun)):
                program = ("events", kind, "filter_event", "subjects", *shape, "count")
                yield f"{len(doing)}", f"how many {plural(noun)} {verb}", program


def _can_topple(story: Story, noun: str) -> bool:
    slots = [slot for slot in story.facts.moving if story.facts.nouns[slot] == noun]
    shape = story.facts.columns["objects/shape"]
    return bool(story.facts.gravity.any()) and all(
        shape[slot] == POLYGON and slot not in story.facts.joined for slot in slots
    )


def _color(story: Story) -> Iterator[Candidate]:
    """The colour of an object that its place, its size or its shape tells apart."""
    for slot in story.facts.moving:
        word = story.references.colors[slot]
        if word and story.facts.nouns[slot] != "link":
            for text, program in story.references.without_color(slot):
                yield word, f"what colour is the {text}", (*program, "query_color")


def _happens(story: Story) -> Iterator[Candidate]:
    """Whether an object topples, leaves the view or comes to rest."""
    for slot, ref in _named(story).items():
        for kind, verb in VERBS.items():
            if kind != "topple" or _can_topple(story, story.facts.nouns[slot]):
                does = any(action.slot == slot and action.kind in EVENTS[kind] for action in story.actions)
                program = ("events", kind, "filter_event", *ref.program, "filter_object", "exist")
                yield YES_NO[does], f"does {ref.text} {verb}", program


def _pairs(story: Story) -> Iterator[tuple[int, int]]:
    """Moving objects with a phrase of their own, each with others, or static objects, that have one, too."""
    named, refs = _named(story), story.references.all
    for a in named:
        if a in story.facts.joined:
            continue
        yield from ((a, b) for b in named if a < b and b not in story.facts.joined)
        yield from ((a, b) for b in _static(story) if refs[b].unique and b not in story.facts.screens)


def _hits(story: Story) -> Iterator[Candidate]:
    """Whether two objects hit each other; pairs that touch without a hit are left out."""
    if story.facts.missed:
        return
    hit = {frozenset((each.a, each.b)) for each in story.facts.hits}
    for a, b in _pairs(story):
        touching = any(b in others for others in story.facts.touches.get(a, {}).values())
        if frozenset((a, b)) in hit or not touching:
            yield YES_NO[frozenset((a, b)) in hit], *hit_question(story, a, b)


def hit_question(story: Story, a: int, b: int) -> tuple[str, tuple[str, ...]]:
    """Question whether two objects hit each other, and its program."""
    one, other = story.references.all[a], story.references.all[b]
    question = (
        f"do {one.text} and {other.text} hit each other"
        if b in story.facts.moving
        else f"does {one.text} hit {other.text}"
    )
    return question, ("events", "hit", "filter_event", *one.program, "filter_object", *other.program, "filter_object",
                      "exist")  # fmt: skip


def _first_hit(story: Story) -> Iterator[Candidate]:
    """What an object hits, or is hit by, first."""
    refs = story.references.all
    for slot, ref in _named(story).items():
        first = next((hit for hit in story.facts.hits if slot in (hit.a, hit.b)), None)
        if first is None or not refs[first.a].unique or not refs[first.b].unique:
            continue
        partner = first.b if slot == first.a else first.a
        program = ("events", "hit", "filter_event", *ref.program, "filter_object", "first", *ref.program, "partner")
        answer = refs[partner].text.removeprefix("the ")
        yield answer, f"what does {ref.text} collide with first", (*program, "describe")


def _predict(story: Story) -> Iterator[Candidate]:
    """What happens after a part of the video: a hit, a fall, the view left, rest."""
    facts = story.facts
    share = OBSERVED[int(story.grammar.pick("observed", ORDER)) % len(OBSERVED)]
    frame = round(share * (len(facts.position) - 1))
    time = f"{frame / facts.video.fps:.{story.decimals}f}"
    after = (time, "filter_after")
    for slot, ref in _named(story).items():
        pixel = facts.pixels(frame)[slot]
        seen = ((pixel >= 0) & (pixel < [facts.video.width, facts.video.height])).all()
        turned = abs(facts.angle[frame, slot] - facts.angle[0, slot])
        open_ = {
            "leave": seen,
            "topple": _can_topple(story, facts.nouns[slot]) and turned < np.pi / 8,
            "rest": facts.point_speed[frame, slot] >= REST_SPEED,
        }
        for kind, verb in VERBS.items():
            if open_.get(kind):
                later = [a for a in story.actions if a.slot == slot and a.kind in EVENTS[kind] and a.time > float(time)]
                program = ("events", kind, "filter_event", *after, *ref.program, "filter_object", "exist")
                yield YES_NO[bool(later)], f"after {time} s, does {ref.text} {verb}", program
    if facts.missed:
        return
    hit = {frozenset((each.a, each.b)) for each in facts.hits if each.time > float(time)}
    for a, b in _pairs(story):
        touching = any(b in others for others in facts.touches.get(a, {}).values())
        if frozenset((a, b)) in hit or not touching:
            question, program = hit_question(story, a, b)
            yield (
                YES_NO[frozenset((a, b)) in hit],
                f"after {time} s, {question}",
                (*program[:3], *after, *program[3:]),
            )


# ---- Questions of matched sets


def counterfactual_questions(original: Story, member: Story, number: int) -> Iterator[Question]:
    """Questions about an original video, whose answers are those of member `number` of its set.

    They begin with the change that can be said in words, and ask whether two objects would then hit each other.
    """
    change = _change(original, member)
    if not change or original.facts.missed or member.facts.missed:
        return
    shared = set(original.facts.nouns) & set(member.facts.nouns)
    for a, b in _pairs(original):
        pair = frozenset((a, b))
        touching = any(b in others for others in member.facts.touches.get(a, {}).values())
        hit = any(frozenset((each.a, each.b)) == pair for each in member.facts.hits)
        if {a, b} <= shared and (hit or not touching):
            question, program = hit_question(original, a, b)
            verb, _, rest = question.partition(" ")
            assert verb in ("do", "does")
            text = f"{change}, would {rest}?"
            words = (f"{number}", "member_events", *program[1:])
            yield Question("counterfactual", "would_hit", text, run(words, original, {number: member}), words)


def _change(original: Story, member: Story) -> str:
    """The beginning of a sentence about what differs in a member of a set; "" if words do not say it."""
    one, two = original.facts, member.facts
    gone = set(one.nouns) - set(two.nouns)
    if len(gone) == 1:
        ref = original.references.all[gone.pop()]
        return f"Without {ref.text}" if ref.unique else ""
    columns = {
        "mass": ("heavier", "lighter"),
        "elasticity": ("bouncier", "less bouncy"),
        "friction": ("rougher", "smoother"),
    }
    differing = {
        name: np.flatnonzero(one.columns[f"objects/{name}"] != two.columns[f"objects/{name}"])
        for name in columns
        if f"objects/{name}" in one.columns
    }
    differing = {name: slots for name, slots in differing.items() if len(slots)}
    same_start = all(np.array_equal(getattr(one, name)[0], getattr(two, name)[0]) for name in ("position", "velocity"))
    if len(differing) != 1 or not same_start or not np.array_equal(one.gravity, two.gravity):
        return ""
    ((name, slots),) = differing.items()
    ref = original.references.all.get(int(slots[0]))
    if len(slots) != 1 or ref is None or not ref.unique:
        return ""
    more = two.columns[f"objects/{name}"][slots[0]] > one.columns[f"objects/{name}"][slots[0]]
    return f"If {ref.text} were {columns[name][0 if more else 1]}"
