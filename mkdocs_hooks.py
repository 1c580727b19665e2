"""Hooks of mkdocs: README and CONTRIBUTING as pages, links to files outside docs/, and a check for external content.

The Markdown files are written for a reader in a clone, where a link leads to any file. On the pages, README.md and
CONTRIBUTING.md stand beside those of docs/, and a link to any other file of the repository leads to a page that shows
it. A link without a target stays as it is: mkdocs then warns, and a strict build fails.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

import griffe
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent
PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md"}
"""Pages whose source lies outside docs/: path in the repository → path among the pages."""

SHOWN = "repository"
_LINK = re.compile(r"\]\(([^)#\s]+)(#[^)\s]*)?\)")
_FENCE = re.compile(r"^ *(```|~~~)")
_LANGUAGE = {".py": "python", ".yaml": "yaml", ".yml": "yaml", ".json": "json", ".toml": "toml", ".sh": "bash"}
_LOADED = re.compile(r"""<(?:script|img|iframe|source|video|audio|embed)\b[^>]*?\bsrc=["']?(?:https?:)?//[^"'\s>]*"""
                     r"""|<link\b(?![^>]*rel=["']?canonical)[^>]*?\bhref=["']?(?:https?:)?//[^"'\s>]*"""
                     r"""|@import\s+["']?(?:url\()?["']?(?:https?:)?//\S*|url\(["']?(?:https?:)?//[^)]*""",
                     re.IGNORECASE)


def linked(text: str, home: str) -> list[str]:
    """Repository paths of the links in a Markdown text that lies in the folder ``home`` of the repository."""
    return [posixpath.normpath(posixpath.join(home, target)) for target, _ in _links(text)]


def placed(path: str) -> str | None:
    """Return the place of a file among the pages; None if it has no page, such as a folder."""
    if path in PAGES:
        return PAGES[path]
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return f"{SHOWN}/{path}.md" if (ROOT / path).is_file() else None


def relinked(text: str, home: str, page: str) -> str:
    """The text with its links as they must be on ``page``; ``home`` is the repository folder that they start from."""

    def link(match: re.Match[str]) -> str:
        target, anchor = match[1], match[2] or ""
        if _foreign(target):
            return match[0]
        path = posixpath.normpath(posixpath.join(home, target))
        if (ROOT / path).is_dir():
            raise PluginError(f"{home or 'README.md'}: a link to the folder {path}, which has no page: name it as code")
        to = placed(path)
        return match[0] if to is None else f"]({posixpath.relpath(to, posixpath.dirname(page) or '.')}{anchor})"

    lines, inside = [], False
    for line in text.splitlines(keepends=True):
        inside ^= bool(_FENCE.match(line))
        lines.append(line if inside else _LINK.sub(link, line))
    return "".join(lines)


def loaded_from_elsewhere(text: str) -> list[str]:
    """Return what a page or a style sheet would load from another machine. Plain links do not count."""
    return [match[0] for match in _LOADED.finditer(text)]


def on_files(files: Files, config: Any) -> Files:
    """Add README, CONTRIBUTING, and a page for each file that any page links to."""
    sources = {path: (ROOT / path).read_text(encoding="utf-8") for path in PAGES if (ROOT / path).is_file()}
    sources |= {f"docs/{file.src_uri}": file.content_string for file in files.documentation_pages()}
    targets: set[str] = set()
    for path, text in sources.items():
        if path in PAGES:
            files.append(File.generated(config, PAGES[path], content=relinked(text, "", PAGES[path])))
        targets.update(linked(text, posixpath.dirname(path)))
    for target in sorted(targets):
        to = placed(target)
        if to is not None and to.startswith(f"{SHOWN}/"):
            files.append(File.generated(config, to, content=_shown(target)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead the links of a page of docs/ to where their files stand now."""
    uri = page.file.src_uri
    if page.file.generated_by is not None:
        return markdown
    return relinked(markdown, posixpath.dirname(f"docs/{uri}"), uri)


def on_post_build(config: Any, **_: Any) -> None:
    """PluginError if anything of what was built would be loaded from elsewhere."""
    site = Path(config.site_dir)
    for path in sorted(site.rglob("*")):
        if path.suffix in {".html", ".css"} and (found := loaded_from_elsewhere(path.read_text(encoding="utf-8"))):
            raise PluginError(f"{path.relative_to(site)} loads from elsewhere: {found[0]}")


class OurDocstrings(griffe.Extension):
    """Reads docstrings as they are written here.

    A paragraph that ends in ``::`` announces an indented block, which Markdown shows without being told. The comment
    behind a field or a member of an enum says what it is.
    """

    def on_instance(self, *, obj: griffe.Object | griffe.Alias, **_: Any) -> None:
        if not obj.is_alias and obj.docstring is not None:
            obj.docstring.value = plain_blocks(obj.docstring.value)

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        if attr.docstring is None and attr.parent and attr.parent.is_class and attr.endlineno:
            line = attr.lines_collection[attr.filepath][attr.endlineno - 1]
            comment = re.search(r"\s#\s+(?!noqa|type:)(\S.*)$", line)
            if comment is not None:
                attr.docstring = griffe.Docstring(comment[1], parent=attr)


def plain_blocks(docstring: str) -> str:
    """``text::`` becomes ``text:``; a ``::`` of its own goes."""
    return re.sub(r"(?m)^::\n", "", re.sub(r"(?m)(?<=\S)::$", ":", docstring))


def _links(text: str) -> list[tuple[str, str]]:
    found, inside = [], False
    for line in text.splitlines():
        inside ^= bool(_FENCE.match(line))
        if not inside:
            found += [(match[1], match[2] or "") for match in _LINK.finditer(line) if not _foreign(match[1])]
    return found


def _foreign(target: str) -> bool:
    return bool(re.match(r"[a-z]+:|//|mailto:", target))


def _shown(path: str) -> str:
    text = (ROOT / path).read_text(encoding="utf-8")
    fence = "`" * max(3, 1 + max((len(run) for run in re.findall(r"`+", text)), default=0))
    language = _LANGUAGE.get(posixpath.splitext(path)[1], "text")
    return f"---\nsearch:\n  exclude: true\n---\n# {path}\n\n{fence}{language}\n{text.rstrip()}\n{fence}\n"
