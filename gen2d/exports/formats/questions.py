"""Questions with their answers and programs, one JSON object per line, balanced over the answers.

Each line has `video` (the key of the other exports), `split`, `number`, `type`, `template`, `question`, `answer` and
`program`. Questions of matched sets are added: `member_video` is the video whose events answer them. Of each template,
'yes' and 'no' are as frequent, to within one question, and no other answer is more than twice as frequent as the
average one; questions beyond that are left out. Contacts must be stored.
"""

import json
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from gen2d.plugin import Batch, ConfigError, Export, Source, caption, questions
from gen2d.plugin import dataset as loader

PER_MEMBER = 2  # questions about a member of a matched set
MATCHED = "matched/member"


def write(target: Path, source: Source) -> None:
    """Write the file."""
    stored = source.ds.manifest.fields
    names = [name for name in (*caption.REQUIRED_FIELDS, *caption.OPTIONAL_FIELDS, MATCHED) if name in stored]
    names = [name for name in names if stored[name].per_video]
    ds = loader.open(source.ds.root, source.ds.options.split, names)
    height, width = source.frame_size
    video_size = SimpleNamespace(fps=source.fps, height=height, width=width)
    balance = Balance()
    with target.open("w", encoding="utf-8", newline="\n") as file:
        original: Any = None
        first = 0
        for number in range(len(ds)):
            video = _within_frames(ds[number])
            story = caption.story_of(video | dict(ds.manifest.constants), video_size)
            asked = [(number, question, {}) for question in questions.questions_of(story)]
            if int(video.get(MATCHED, 0)) == 0:
                original, first = story, number
            elif original is not None:
                about = _about_member(original, story, int(video[MATCHED]))
                asked += [(first, question, {"member_video": source.key(number)}) for question in about]
            for asked_of, question, more in asked:
                if balance.takes(question):
                    origin = {"video": source.key(asked_of), "split": source.ds.options.split, "number": asked_of}
                    file.write(json.dumps(origin | question.json | more) + "\n")
            source.advance(1)


def _within_frames(video: Batch) -> Batch:
    """A video without the contacts after its last frame: a split may be shorter than what is stored."""
    seen = video["contacts/frame"] < len(video["states/position"])
    if seen.all():
        return video
    rows = {name: values[seen] for name, values in video.items() if name.startswith("contacts/") and values.ndim}
    return video | rows | {"contacts/count": np.array(seen.sum())}  # all of them, as a later one is stored


def _about_member(original: Any, member: Any, number: int) -> Iterator[questions.Question]:
    """A question with each answer, if there are such."""
    candidates = list(questions.counterfactual_questions(original, member, number))
    for answer in questions.YES_NO:
        matching = [question for question in candidates if question.answer == answer]
        if matching and len({question.answer for question in candidates}) == PER_MEMBER:
            yield matching[int(original.grammar.pick(f"{answer} {number}", questions.ORDER)) % len(matching)]


class Balance:
    """Numbers of the questions taken, by type, template and answer."""

    def __init__(self) -> None:
        self.taken: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)

    def takes(self, question: questions.Question) -> bool:
        """Count a question and return True, unless its answer has been too frequent."""
        counts, answer = self.taken[question.type, question.template], question.answer
        if answer in questions.YES_NO:
            fair = counts[answer] <= min(counts[other] for other in questions.YES_NO)
        else:
            fair = counts[answer] < 2 * (counts.total() + 1) / len(counts | {answer: 1})
        counts[answer] += fair
        return fair


def check(source: Source) -> None:
    """Raise ConfigError if contacts are not stored."""
    if "contacts/kind" not in source.ds.manifest.fields:
        raise ConfigError(
            f"{source.ds.root} has no contacts, which questions need: make it with annotations.contacts=4"
        )


EXPORT = Export(
    fields=("index",), write=write, check=check, fixed=True, suffix=".jsonl", loss="questions and answers alone"
)
