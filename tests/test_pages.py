"""The pages of the documentation: their blocks run, their links lead somewhere, their tables are those of the code."""

import importlib
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import pages
import pytest
from packages import require

from gen2d.config.config import load_config
from gen2d.programs.rollout import Rollout

ROOT = pages.ROOT
ELSEWHERE = {"docs/loading.md"}  # whose blocks loading/test_loading_page.py runs
OTHERS = [
    *("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "datasets/README.md", "gen2d/README.md", "tests/README.md"),
]
NOT_OURS = {"config.yaml", "my/format.py"}  # of a dataset, of a reader


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the datasets that several pages read."""
    return tmp_path_factory.mktemp("store")


def with_blocks() -> list[str]:
    """Pages of which blocks run."""
    run = {"sh", "yaml", "python"}
    return [page for page in pages.DOCS if page not in ELSEWHERE and any(kind in run for kind, _ in pages.blocks(page))]


@pytest.mark.full
@pytest.mark.parametrize("page", with_blocks())
def test_the_blocks_of_a_page_run(
    page: str,
    store: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    record_property: Callable[[str, object], None],
):
    monkeypatch.chdir(tmp_path)  # where the blocks' own files lie
    monkeypatch.setenv("HF_HOME", str(tmp_path / "huggingface"))
    reader = pages.Reader(tmp_path, store)
    for kind, block in pages.blocks(page):
        reader.run(kind, block)
    for name in reader.left_out:
        record_property("not run", name)
    if page == "docs/training.md":
        assert reader.compared == 2 - ("torch" in reader.left_out)


@pytest.mark.parametrize("page", [*OTHERS, *pages.DOCS])
def test_blocks_are_fenced_and_of_a_known_language(page: str):
    assert {kind for kind, _ in pages.blocks(page)} <= pages.LANGUAGES
    for kind, block in pages.blocks(page):
        assert kind != "sh" or list(pages.commands(block)) or "pip install" in block


def anchors(page: Path) -> set[str]:
    """Anchors of the headings of a page."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title).strip().lower().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", [*OTHERS, *pages.DOCS])
def test_links_lead_to_files_and_headings(page: str):
    text = re.sub(r"^```.*?^```", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        target, _, anchor = link.partition("#")
        if "://" in target:
            continue
        path = ((ROOT / page).parent / target).resolve() if target else ROOT / page
        name = path.relative_to(ROOT).as_posix()
        assert path.exists(), f"{page} links to {link}"
        assert not anchor or anchor in anchors(path), f"{page} links to {link}, but {name} has no such heading"


@pytest.mark.full
def test_the_site_is_built_without_a_warning(tmp_path: Path):
    require("mkdocs", "material", "mkdocstrings")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    names = {path.relative_to(tmp_path / "site").as_posix() for path in (tmp_path / "site").rglob("*.html")}
    assert names >= {"index.html", "physics/index.html", "api/gen2d/index.html"}


@pytest.mark.parametrize("module", ["gen2d", "gen2d.plugin", "gen2d.grain", "gen2d.torch", "gen2d.engines"])
def test_every_public_name_is_in_the_reference(module: str):
    if module == "gen2d.torch":
        require("torch")
    public = importlib.import_module(module)
    names = getattr(public, "__all__", None) or [
        name for name in dir(public) if name[0].isupper() and name != "TYPE_CHECKING"
    ]
    text = "\n".join((ROOT / page).read_text(encoding="utf-8") for page in pages.DOCS if "/api/" in page)
    described = set(re.findall(rf"^::: {re.escape(module)}\.(\w+)$", text, re.MULTILINE)) | set(
        re.findall(r"`(\w+)`", text)
    )
    assert set(names) <= described


@pytest.mark.parametrize("page", ["gen2d/README.md", "tests/README.md", *pages.DOCS])
def test_pages_name_only_files_that_are_there(page: str):
    text = (ROOT / page).read_text(encoding="utf-8")
    written = {block.partition("\n")[0].removeprefix("# ") for _, block in pages.blocks(page)}
    for name in set(re.findall(r"`([\w./]+\.(?:py|yaml))`", text)) - written - NOT_OURS:
        beside = [] if page.startswith("docs/") else [(ROOT / page).parent, *(ROOT / "tests").glob("*/")]
        roots = [ROOT, ROOT / "configs", *beside]
        assert any((root / name).exists() for root in roots), f"{page} names {name}"


EVERY = ("energy", "masks", "amodal", "boxes", "visibility", "flow", "captions", "lyapunov", "classes", "centers")
SURFACES = ("depth", "normals", "shadow")
DESCRIBED = {
    "scene": "bouncing",
    "look": {"name": "studio", "palette": "paper"},
    "annotations": {"contacts": 4, "tracks": 8, **dict.fromkeys((*EVERY, *SURFACES), True)},
    "image": {"noise": 2, "jpeg_quality": 80, "occluders": 2},
    "quality": {"min_contacts": 1},
    "splits": {"train": {}, "large": {"factors": {"radius": [1.0, 1.1]}}},
}


def test_the_table_of_fields_is_that_of_the_schema():
    """Names, axes and units; each group of fields has a row."""
    fields = Rollout(load_config(DESCRIBED), jax.devices()[:1]).schema.fields
    rows = re.findall(
        r"^\| (`.*) \| (n.*|T, n) \| (.*) \|$", (ROOT / "docs/fields.md").read_text(encoding="utf-8"), re.M
    )
    described: set[str] = set()
    for cells in rows:
        group, names = "", []
        for name in re.findall(r"`([^`]+)`", cells[0]):
            group = name.rpartition("/")[0] or group
            own = name if name in fields or "/" in name else f"{group}/{name}"
            names += [each for each in fields if each.startswith(own[:-3])] if own.endswith("...") else [own]
        assert names, cells
        axes = cells[1].split(", ")
        axes = axes if len(axes) == len(names) else [axes[0]] * len(names)
        for name, written in zip(names, axes, strict=True):
            field = fields[name]
            assert field.axes.startswith("n") if written.endswith("...") else field.axes == written, (name, field.axes)
            about = cells[2].startswith(("with ", "each ", "distance "))  # in place of units
            assert about or not cells[2] or field.unit in ("1", "", "id", "object") or field.unit in cells[2], name
        described.update(names)
    assert {name.partition("/")[0] for name in fields} == {name.partition("/")[0] for name in described} | {"split"}
