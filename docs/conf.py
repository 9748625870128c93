"""The site of the documentation: ``make docs`` writes it to ``docs/_build``, without network."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import typer.main
from sphinx.application import Sphinx
from sphinx.util import logging
from typer.cli import get_docs_for_click

from stereotruth import __version__
from stereotruth.project.main import app as command

LOG = logging.getLogger(__name__)
DOCS = Path(__file__).parent
ROOT = DOCS.parent
COMMANDS = ROOT / "src" / "stereotruth" / "command"

project = "stereotruth"
author = "The stereotruth developers"
copyright = "The stereotruth developers, Apache-2.0"
version = release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc"]
exclude_patterns = ["_build"]
highlight_language = "text"
nitpicky = True
nitpick_ignore_regex = [("py:.*", ".*")]  # types of NumPy and others: their pages are not at hand

myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]

autodoc_typehints = "signature"
autodoc_type_aliases = {"ArrayLike": "ArrayLike"}  # not the union that it stands for
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
autodoc_preserve_defaults = True

html_theme = "furo"
html_title = f"stereotruth {version}"
html_copy_source = False
html_static_path = ["static"]
html_css_files = ["site.css"]

# What lies beside the files that it tells of, and its page here.
HOMES = {
    "bench/README.md": "benchmarks",
    "config/README.md": "reference/configuration",
    "envs/README.md": "reference/environments",
    "profiles/README.md": "reference/profiles",
    "CONTRIBUTING.md": "contributing",
    "README.md": "index",
}
INCLUDED = re.compile(r"^```\{include\} (\S+)\n```$", re.MULTILINE)
LINK = re.compile(r"(?<!`)\[([^\]\n]*)\]\(([^)\s#]+)(#[^)\s]*)?\)")


def with_links(text: str, file: Path, page: str) -> str:
    """Text of ``file`` with its links as they go from ``page``.

    A link to a file that has no page becomes its path; one to what is not there is a warning.
    """

    def link(found: re.Match[str]) -> str:
        words, target, anchor = found[1], found[2], found[3] or ""
        if "://" in target:
            return found[0]
        there = (file.parent / target).resolve()
        if not there.exists():
            LOG.warning("%s links to %s, which is not there", file.relative_to(ROOT), target)
            return found[0]
        name = there.relative_to(ROOT).as_posix()
        if name in HOMES:
            there = DOCS / f"{HOMES[name]}.md"
        elif not there.is_relative_to(DOCS):
            return f"`{name}`"
        return f"[{words}]({Path(os.path.relpath(there, (DOCS / page).parent)).as_posix()}{anchor})"

    return LINK.sub(link, text)


def complete(app: Sphinx, page: str, source: list[str]) -> None:
    """Put what stands elsewhere, and what is generated, into the text of a page."""
    here = Path(app.env.doc2path(page))

    def include(found: re.Match[str]) -> str:
        file = (here.parent / found[1]).resolve()
        app.env.note_dependency(str(file))
        return with_links(file.read_text(encoding="utf-8"), file, page)

    text = with_links(source[0], here, page)
    text = INCLUDED.sub(include, text)
    if shown := NOTEBOOK.search(text):
        app.env.note_dependency(str(here.parent / shown[1]))
        text = notebook(here.parent / shown[1])
    if "<!-- command line -->" in text:
        for code in (Path(__file__), *COMMANDS.glob("*.py")):  # the page follows from these
            app.env.note_dependency(str(code))
        text = text.replace("<!-- command line -->", command_line())
    source[0] = text


NOTEBOOK = re.compile(r"^<!-- notebook: (\S+) -->$", re.MULTILINE)


def notebook(file: Path) -> str:
    """An executed notebook as Markdown: its text, code, what that said, and pictures."""
    parts = []
    for cell in json.loads(file.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", []):
            if "text" in output:
                parts.append(f"```text\n{''.join(output['text'])}```")
            else:
                png = output["data"]["image/png"]
                parts.append(f'<img alt="What the code draws" src="data:image/png;base64,{png}">')
    return "\n\n".join(parts) + "\n"


EXAMPLES = re.compile(r"^\[bold\]Examples\[/bold\]\n((?:\n\[cyan\].*\[/cyan\]\n)+)", re.MULTILINE)
CYAN = re.compile(r"\[cyan\](.*?)\[/cyan\]")


def command_line() -> str:
    """Help of all commands, as Markdown."""
    click = typer.main.get_command(command)
    context = click.make_context("stereotruth", [], resilient_parsing=True)
    for group in [click, *click.commands.values()]:  # their lists cut what has no short help
        for one in getattr(group, "commands", {}).values():
            one.short_help = " ".join((one.help or "").split()).partition(". ")[0].rstrip(".") + "."
    text = get_docs_for_click(obj=click, ctx=context, name="stereotruth")
    text = re.sub(r"(?m)^(?!\[cyan\])(.*)$", lambda line: CYAN.sub(r"`\1`", line[1]), text)

    def examples(found: re.Match[str]) -> str:
        lines = re.findall(r"\[cyan\](.*)\[/cyan\]", found[1])
        return "\n".join(["**Examples**:", "", "```console", *(f"$ {x}" for x in lines), "```", ""])

    return EXAMPLES.sub(examples, text.partition("\n")[2])


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", complete)
