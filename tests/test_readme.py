"""The README: its set-up is one line each, its blocks run, and it is short."""

import re
from pathlib import Path

import pages
import pytest

README = pages.ROOT / "README.md"


def test_the_set_up_is_one_line_each():
    lines = [line for kind, block in pages.blocks("README.md") if kind == "sh" for line in block.splitlines()]
    installing = [line for line in lines if "pip install" in line]
    assert len(installing) == 2
    assert installing[0].endswith("&& python -m gen2d --config bouncing.yaml --n 10000")
    assert installing[1].endswith("&& pytest")


def test_the_blocks_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)  # where the blocks' own files lie
    reader = pages.Reader(tmp_path, tmp_path)
    for kind, block in pages.blocks("README.md"):
        reader.run(kind, block)
    assert {path.name for path in (tmp_path / "datasets").iterdir()} == {"bouncing", "small"}


def test_it_is_read_in_five_minutes_and_leads_to_every_page():
    text = README.read_text(encoding="utf-8")
    assert len(text.split()) < 1300
    linked = set(re.findall(r"\]\((docs/\w+\.md)\)", text))
    assert linked == {page for page in pages.DOCS if "/api/" not in page}
