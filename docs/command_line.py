"""Write the help of every command into docs/command_line.md when MkDocs builds the site."""

from __future__ import annotations

import io
import os
import re
from contextlib import redirect_stdout, suppress
from typing import Any

from amvnet.cli.main import main
from amvnet.cli.parser import HELP_ALL

PAGE = "command_line.md"
PLACE = "<!-- the help of every command -->"
WIDTH = 100  # the width of the help, characters


def help_of(*words: str, option: str = "--help") -> str:
    """Return what `amvnet WORDS` prints with --help or another option."""
    os.environ["COLUMNS"] = str(WIDTH)
    printed = io.StringIO()
    with redirect_stdout(printed), suppress(SystemExit):
        main([*words, option])
    return printed.getvalue().strip()


def commands() -> list[str]:
    """Return the commands in the order in which `amvnet --help` lists them."""
    return re.findall(r"(?m)^  (\w+)  ", help_of())


def reference() -> str:
    """Return a section with the help of each command, in Markdown."""
    sections = []
    for command in commands():
        text = help_of(command)
        if HELP_ALL in text:
            text = help_of(command, option=HELP_ALL)
        sections.append(f"## amvnet {command}\n\n```text\n{text}\n```")
    return "\n\n".join(sections)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Fill in the reference; MkDocs calls this for each page."""
    if page.file.src_uri != PAGE:
        return markdown
    return markdown.replace(PLACE, reference())
