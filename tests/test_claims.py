"""Claims of the pages: each sentence that promises something, or states a number, has an entry in claims.toml.

The entry is the sentence, and what holds it: a list of tests (`tests/FILE.py::test_name`) and rows of the benchmark
(`tests/bench/FILE.py::text of the row`). A sentence that claims nothing has a reason in their place, one of REASONS.
"""

import ast
import difflib
import functools
import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

TESTS = Path(__file__).parent
ROOT = TESTS.parent
CLAIMS: dict[str, dict[str, list[str] | str]] = tomllib.loads((TESTS / "claims.toml").read_text(encoding="utf-8"))
PAGES = [
    *("README.md", "datasets/README.md", "tests/README.md", "gen2d/README.md"),
    *sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md")),
]
REASONS = {
    "definition": "what a word, symbol, field, unit or option means",
    "method": "how the code computes something, without a promise of the result",
    "setting": "with what the figures nearby were measured",
    "instruction": "what the reader may run, write or set",
    "limit": "what gen2d cannot do, or does not promise",
    "foreign": "what other programs do",
}
# A sentence with one of these words always needs a test or a benchmark: no reason excuses it.
STRONG = r"exact(?:ly)?|never|always|every\w*|guarante\w+|to the (?:bit|byte)|(?:bit|byte|pixel) (?:for|by) \w+"
WORDS = r"all|any\w*|no|none|nobody|nothing|nowhere|equals?|equally|same|identical|prove[sn]?|fully"
SMALL = r"an? (?:minute|hour)|(?:two|three|four|five|ten|twenty|hundred|thousand) (?:times|seconds|minutes|hours)"
COUNTS = rf"twice|half|thirds?|quarters?|sixth|tenth|thousandth|{SMALL}"
NUMBER = r"(?<![\w.,^-])\.?\d[\d.,]*(?:e-?\d+)?(?![\w-])"
PROMISE = re.compile(rf"\b(?:{STRONG}|{WORDS}|{COUNTS})\b|{NUMBER}", re.IGNORECASE)
# Numbers and words in code, the targets of links, and the dates and numbers of citations promise nothing.
SILENT = re.compile(r"`[^`]*`|\]\([^)]*\)|arXiv \d+\.\d+|\b(?:19|20)\d\d\b")
MACHINE = re.compile(r"EPYC|H200|\bspeed\.md\b")  # the machine of the figures, or a link to the page that names it


class Sentence(NamedTuple):
    """A sentence or a row of a table, on one line, and the heading that it stands under."""

    text: str
    heading: str

    @property
    def promises(self) -> list[str]:
        """Words and numbers that need an entry in claims.toml."""
        return [found[0] for found in PROMISE.finditer(SILENT.sub("`", self.text))]


def sentences(page: str) -> Iterator[Sentence]:
    """The sentences of a page, without its code, headings, and heads of tables."""
    text = (ROOT / page).read_text(encoding="utf-8")
    text = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^\|.*\n\|[-| ]+\|$", "", text, flags=re.MULTILINE)
    text = re.sub(r"^(?=#|\||- |\d+\. )", "\n", text, flags=re.MULTILINE)  # each is a paragraph of its own
    heading = ""
    for paragraph in re.split(r"\n\s*\n", text):
        line = " ".join(paragraph.split())
        if line.startswith("#"):
            heading = line
        elif line.startswith("|"):
            yield Sentence(line, heading)
        elif not paragraph.strip("\n").startswith("    "):
            line = re.sub(r"^(?:-|\d+\.) ", "", line)
            for sentence in re.split(r"(?<=[^ ][.!?]) (?=[A-Z`*\[(]|gen2d |jax |mp4)", line):
                yield Sentence(sentence, heading)


def line_of(sentence: str, proofs: list[str] | str) -> str:
    """The line of claims.toml for a sentence."""
    return f"{json.dumps(sentence, ensure_ascii=False)} = {json.dumps(proofs)}"


def complaints(page: str) -> Iterator[str]:
    """What is wrong with the entries of a page, each with what to do."""
    entries, promising = CLAIMS.get(page, {}), {each.text: each for each in sentences(page) if each.promises}
    stale = [entry for entry in entries if entry not in promising]
    for text, sentence in promising.items():
        promises = ", ".join(sentence.promises)
        strong = [each for each in sentence.promises if re.fullmatch(STRONG, each, re.IGNORECASE)]
        if text not in entries:
            before = difflib.get_close_matches(text, stale, 1, 0.7)
            stale = [entry for entry in stale if entry not in before]
            proofs = entries[before[0]] if before else ["tests/FILE.py::test_NAME"]
            todo = f"Replace, if it still holds,\n    {before[0]}\n  by" if before else "Add"
            yield f"A claim has {'changed' if before else 'no entry'} ({promises}). {todo}\n    {line_of(text, proofs)}"
        elif isinstance(entries[text], str) and strong:
            yield f"No reason excuses '{strong[0]}': name a test, or say less.\n    {text}"
    for entry in stale:
        yield f"The page no longer says this, or it promises nothing any more: remove the entry.\n    {entry}"


@functools.cache
def own_tests(file: str) -> dict[str, bool]:
    """The tests of a file, and whether each may run."""
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
    return {
        node.name: not any(re.search(r"mark\.(?:skip|xfail)\b", ast.unparse(each)) for each in node.decorator_list)
        for node in functions
    }


@functools.cache
def texts_of(file: str) -> list[str]:
    """The strings of a file."""
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    return [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]


def missing(proof: str) -> str | None:
    """What is wrong with a test or a row of the benchmark."""
    file, _, name = proof.partition("::")
    if not (ROOT / file).is_file():
        return f"there is no file {file}"
    if file.startswith("tests/bench/bench"):
        return None if any(name in text for text in texts_of(file)) else f"{file} has no row '{name}'"
    if name not in own_tests(file):
        close = difflib.get_close_matches(name, own_tests(file), 1)
        return f"{file} has no test '{name}'{f' (but {close[0]})' if close else ''}"
    return None if own_tests(file)[name] else f"{proof} is skipped or expected to fail"


def fail_with(page: str, complaints: list[str]) -> None:
    """Fail with the complaints about a page, if there are any."""
    if complaints:
        reasons = "\n".join(f"  {reason}: {meaning}" for reason, meaning in REASONS.items())
        pytest.fail(
            f"{page}: {len(complaints)} claims need you\n\n" + "\n\n".join(complaints) + "\n\n"
            f'Entries stand in tests/claims.toml under ["{page}"]. If the sentence claims nothing, say why, as in\n'
            f'"SENTENCE" = "definition":\n{reasons}\nIf nothing holds the sentence, write a test or say less.',
            pytrace=False,
        )


@pytest.mark.parametrize("page", PAGES)
def test_each_claim_of_a_page_has_an_entry_and_each_entry_a_claim(page: str):
    fail_with(page, list(complaints(page)))


@pytest.mark.parametrize("page", PAGES)
def test_what_holds_a_claim_is_there(page: str):
    wrong = []
    for entry, proofs in CLAIMS.get(page, {}).items():
        if isinstance(proofs, str):
            if proofs not in REASONS:
                wrong.append(f"'{proofs}' is no reason.\n    {entry}")
            continue
        errors = [error for proof in proofs if (error := missing(proof))] if proofs else ["nothing is named"]
        wrong += [f"Its proof is lost: {error}. Name the test that holds it now.\n    {entry}" for error in errors]
    fail_with(page, wrong)


@pytest.mark.parametrize("page", PAGES)
def test_measured_figures_stand_beside_their_machine(page: str):
    sections: dict[str, str] = {}
    for sentence in sentences(page):
        sections[sentence.heading] = f"{sections.get(sentence.heading, '')} {sentence.text}"
    wrong = []
    for entry, proofs in CLAIMS.get(page, {}).items():
        if any(proof.startswith("tests/bench/bench") for proof in proofs if isinstance(proofs, list)):
            wrong += [
                f"Section '{each.heading}' says figures but not on what machine: name it, or link to docs/speed.md."
                for each in sentences(page)
                if each.text == entry and not MACHINE.search(sections[each.heading])
            ]
    fail_with(page, sorted(set(wrong)))


def test_no_page_is_forgotten():
    assert CLAIMS.keys() == set(PAGES)


TRIAL = """# Title with 3 words

Frames are never lost. The width is `64` px, see [it](page.md#64), arXiv 2411.02385.
- It takes 2 s in all.

    never in code

| what | 4 |
|---|---|
| rows | 5 px |
"""
NEVER, TAKES, ROWS = "Frames are never lost.", "It takes 2 s in all.", "| rows | 5 px |"
HELD = ["tests/test_claims.py::test_what_is_wrong_is_said"]
ENTRIES = {NEVER: HELD, TAKES: "setting", ROWS: HELD}


@pytest.mark.parametrize(
    ("page", "entries", "said"),
    [
        (TRIAL, ENTRIES, []),
        (TRIAL, {NEVER: HELD, ROWS: HELD}, [f'A claim has no entry (2, all). Add\n    "{TAKES}" = ["tests/FILE']),
        (
            TRIAL.replace("2 s", "1 s"),
            ENTRIES,
            [f"A claim has changed (1, all). Replace, if it still holds,\n    {TAKES}"],
        ),
        (TRIAL.replace("5 px", "6 px"), ENTRIES, ["A claim has changed (6)"]),
        (TRIAL.replace(" never", ""), ENTRIES, ["or it promises nothing any more: remove the entry"]),
        (TRIAL, {**ENTRIES, "It has 1.": HELD}, ["The page no longer says this"]),
        (TRIAL, {**ENTRIES, NEVER: "definition"}, ["No reason excuses 'never'"]),
    ],
)
def test_what_is_wrong_is_said(
    page: str, entries: dict[str, list[str] | str], said: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "page.md").write_text(page)
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    monkeypatch.setitem(CLAIMS, "page.md", entries)
    found = list(complaints("page.md"))
    assert len(found) == len(said)
    assert all(part in complaint for part, complaint in zip(said, found, strict=True))


def test_lost_proofs_are_said():
    row, file = "tests/bench/bench.py::peak memory", "tests/test_claims.py"
    assert [missing(proof) for proof in (row, *HELD)] == [None, None]
    assert missing(f"{row} of a mouse") == "tests/bench/bench.py has no row 'peak memory of a mouse'"
    assert missing(f"{file}::test_nothing") == f"{file} has no test 'test_nothing'"
    assert missing(f"{file}::test_what_is_wrong") == f"{file} has no test 'test_what_is_wrong' (but {HELD[0][22:]})"
    assert missing("tests/nowhere.py::test_nothing") == "there is no file tests/nowhere.py"
