"""One page that ties results together, as Markdown and as a single HTML file that needs no other."""

from __future__ import annotations

import base64
import html
import json
import shlex
from collections.abc import Collection, Iterator, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from triform.report.listener import Listener
from triform.report.output import write_text
from triform.report.tables import markdown_table
from triform.types import TriformError

#: Options that commands on pages name even where they are the defaults, because a reader asks for them first.
_ALWAYS_SAID = ("controller", "runs", "seed")


@dataclass(frozen=True)
class Section:
    """One result on the page.

    Attributes:
        key: Name of its files.
        title: Heading.
        text: What is shown and how to read it.
        command: What produced it.
        headings: Headings of its table.
        rows: Formatted rows of its table.
        image: Name of its image in the folder; empty if it has none.
        files: Names of its data files in the folder.
    """

    key: str
    title: str
    text: str
    command: str
    headings: list[str]
    rows: list[list[str]]
    image: str
    files: list[str]

    @property
    def drawings(self) -> list[str]:
        """Names of its image as a bitmap and as vectors."""
        return [self.image, str(Path(self.image).with_suffix(".pdf"))] if self.image else []


def spell_command(words: list[str], config: Any, never: Collection[str] = ("output",)) -> str:
    """Return a command that runs ``config`` again, wherever its runs are computed.

    Args:
        words: How the command begins.
        config: Its options, nested dataclasses whose options are flat on the command line.
        never: Options that are left out, because they do not matter.
    """
    return shlex.join([*words, *_spell(config, never)])


def _spell(config: Any, never: Collection[str], usual: Any = None) -> Iterator[str]:
    """Yield the words of options; ``usual`` holds their defaults if they are not those of their class."""
    for option in fields(config):
        value = getattr(config, option.name)
        if option.name in (*never, "execution"):
            continue
        default = option.default if usual is None else getattr(usual, option.name)
        if is_dataclass(value) and not hasattr(value, "label"):
            if usual is None and option.default_factory is not MISSING:
                default = option.default_factory()
            yield from _spell(value, never, default)
        elif option.name in _ALWAYS_SAID or value != default:
            name = option.name.replace("_", "-")
            if isinstance(value, bool):
                yield f"--{name}" if value else f"--no-{name}"
                continue
            yield f"--{name}"
            for each in value if isinstance(value, tuple) else (value,):
                yield str(getattr(each, "label", each))


def read_sections(folder: Path, keys: list[str]) -> list[Section]:
    """Return the sections whose results are in ``folder``, in the order of ``keys``.

    Raises:
        TriformError: A file of that name holds something else.
    """
    sections = []
    for key in keys:
        path = folder / f"{key}.json"
        if not path.exists():
            continue
        try:
            values = json.loads(path.read_text(encoding="utf-8"))["section"]
            sections.append(Section(**{field.name: values[field.name] for field in fields(Section)}))
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise TriformError(
                f"{path} was not written by triform reproduce; remove it or choose another output folder"
            ) from error
    return sections


def write_pages(
    folder: Path, title: str, sections: Sequence[Section], name: str = "index", introduction: str = ""
) -> list[Path]:
    """Write ``name``.md and ``name``.html over ``sections`` into ``folder`` and return their paths."""
    return [
        write_text(folder / f"{name}.md", _markdown(title, sections, introduction)),
        write_text(folder / f"{name}.html", _html(folder, title, sections, introduction)),
    ]


def say_written(listener: Listener, folder: Path, sections: Sequence[Section], pages: Sequence[Path]) -> None:
    """Name the files of sections, which share their data, their images and the pages over them."""
    names = [*sections[0].files, *(name for section in sections for name in section.drawings)]
    for path in [*(folder / name for name in names), *pages]:
        listener.say(f"wrote {path}")


def _markdown(title: str, sections: Sequence[Section], introduction: str) -> str:
    parts = [f"# {title}\n", *([f"{introduction}\n"] if introduction else [])]
    for section in sections:
        parts.append(f"## {section.title}\n\n{section.text}\n")
        if section.image:
            parts.append(f"![{section.title}]({section.image})\n")
        if section.rows:
            parts.append(markdown_table(section.headings, section.rows))
        files = ", ".join(f"[{name}]({name})" for name in section.files)
        parts.append(f"Command: `{section.command}`." + (f" Data: {files}.\n" if files else "\n"))
    return "\n".join(parts)


_CSS = """
body { max-width: 68rem; margin: 2.5rem auto; padding: 0 1.25rem; color: #1a1a1a; background: #fff;
       font: 16px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 3rem; }
img { max-width: 100%; display: block; margin: 1rem 0; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .875rem; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .75rem; text-align: right; border-bottom: 1px solid #ddd; white-space: nowrap; }
th { border-bottom: 2px solid #1a1a1a; }
.note { color: #595959; font-size: .875rem; } code { font-size: .95em; }
"""


def _html(folder: Path, title: str, sections: Sequence[Section], introduction: str) -> str:
    body = [f"<h1>{html.escape(title)}</h1>", *([f"<p>{html.escape(introduction)}</p>"] if introduction else [])]
    for section in sections:
        body.append(f"<h2>{html.escape(section.title)}</h2>\n<p>{html.escape(section.text)}</p>")
        if section.image:
            pixels = base64.b64encode((folder / section.image).read_bytes()).decode("ascii")
            alternative = html.escape(section.title, quote=True)
            kind = Path(section.image).suffix.removeprefix(".")
            body.append(f'<img alt="{alternative}" src="data:image/{kind};base64,{pixels}">')
        if section.rows:
            body.append(_html_table(section))
        files = ", ".join(f'<a href="{name}">{name}</a>' for name in section.files)
        data = f" Data: {files}." if files else ""
        body.append(f'<p class="note">Command: <code>{html.escape(section.command)}</code>.{data}</p>')
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{_CSS}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )


def _html_table(section: Section) -> str:
    head = "".join(f"<th>{html.escape(heading)}</th>" for heading in section.headings)
    rows = "\n".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in section.rows
    )
    return f'<div class="scroll"><table>\n<tr>{head}</tr>\n{rows}\n</table></div>'
