"""Hooks of the site (mkdocs.yml): pages and pictures outside of docs/ join it, and links are rewritten to lead there.

A text has one home: the README is the site's first page, and pages for maintainers lie beside the code. Links name
files of the repository, as a reader of the files follows them. A link to a file that is no page becomes plain text.
"""

import logging
import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
JOINING = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changes.md",
    "gen2d/README.md": "tour.md",
    "tests/README.md": "tests.md",
}
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
BLOCK = re.compile(r"(^```.*?^```$)", re.DOTALL | re.MULTILINE)

log = logging.getLogger("mkdocs.hooks.gen2d")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The files of docs/ and those that join them."""
    for path, name in JOINING.items():
        files.append(File.generated(config, name, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """The page with links that lead to pages of the site."""
    homes = {name: path for path, name in JOINING.items()}
    home = homes.get(page.file.src_uri, f"docs/{page.file.src_uri}")

    def rewritten(found: re.Match[str]) -> str:
        picture, text, link = found.groups()
        target, mark, anchor = link.partition("#")
        if "://" in target or not target:
            return found[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(home), target))
        missing = not (ROOT / path).exists()
        if missing:
            log.warning("%s links to %s, which is not there", home, link)
        name = JOINING.get(path) or (path.removeprefix("docs/") if path.startswith("docs/") else None)
        if name is None:
            return text
        return (
            f"{picture}[{text}]({posixpath.relpath(name, posixpath.dirname(page.file.src_uri) or '.')}{mark}{anchor})"
        )

    parts = BLOCK.split(markdown)
    return "".join(part if part.startswith("```") else LINK.sub(rewritten, part) for part in parts)
