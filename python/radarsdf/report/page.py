# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The parts of a page as HTML. This is the one module that writes tags: it escapes all text that it is given."""

from __future__ import annotations

import base64
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from os import PathLike
from typing import Literal, NamedTuple

from radarsdf.io.files import write_whole
from radarsdf.report.template import TEMPLATE


@dataclass(frozen=True)
class Section:
    """A part of the page with a heading."""

    anchor: str
    """Short name in lower case, which a link may point to."""
    title: str
    body: Sequence[str]
    """HTML, from the functions below."""


class Sentence(NamedTuple):
    """A sentence of the conclusion."""

    mark: Literal["good", "warning", "error", "note"]
    name: str
    """What it is about."""
    text: str


def write_page(
    path: str | PathLike[str],
    title: str,
    command: str,
    facts: Sequence[tuple[str, str]],
    sections: Iterable[Section],
) -> int:
    """Write :func:`page`, whole or not at all, with the `command` that made it and when. Returns its size, bytes."""
    made = f"radarsdf {command}, {time.strftime('%Y-%m-%d %H:%M')}"
    data = page(title, made, facts, sections).encode()
    write_whole(path, data)
    return len(data)


def page(title: str, subtitle: str, facts: Sequence[tuple[str, str]], sections: Iterable[Section]) -> str:
    """The whole page.

    Parameters
    ----------
    title, subtitle
        Text.
    facts
        Names and values that stand above all, as text.
    sections
        In their order.
    """
    sections = list(sections)
    return TEMPLATE.substitute(
        title=escape(title),
        subtitle=escape(subtitle),
        facts="".join(f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in facts),
        links="".join(f'<a href="#{s.anchor}">{escape(s.title)}</a>' for s in sections),
        sections="".join(
            f'<section id="{s.anchor}"><h2>{escape(s.title)}</h2>{"".join(s.body)}</section>\n'
            for s in sections
        ),
    )


def paragraph(text: str) -> str:
    """A paragraph of text."""
    return f"<p>{escape(text)}</p>"


def note(text: str) -> str:
    """A paragraph in smaller letters."""
    return f'<p class="note">{escape(text)}</p>'


def table(caption: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of texts. The first of each row is its heading. Without rows, nothing."""
    lines = [
        f'<tr><th scope="row">{escape(row[0])}</th>{"".join(f"<td>{escape(cell)}</td>" for cell in row[1:])}</tr>'
        for row in rows
    ]
    if not lines:
        return ""
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in header)
    head = f"<thead><tr>{head}</tr></thead>" if any(header) else ""
    return (
        f'<div class="wide"><table><caption>{escape(caption)}</caption>{head}'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def items(marked: Iterable[tuple[str, str, str]]) -> str:
    """A list of a mark, which is one word, a name, and a text."""
    return (
        '<ul class="items">'
        + "".join(
            f'<li><span class="mark {escape(mark)}">{escape(mark)}</span> <b>{escape(name)}</b> {escape(text)}</li>'
            for mark, name, text in marked
        )
        + "</ul>"
    )


def image(data: bytes, alt: str, caption: str, legend: str = "") -> str:
    """A picture, PNG or JPEG, with what it shows for those who do not see it, a caption, and a legend in HTML."""
    kind = "png" if data.startswith(b"\x89PNG") else "jpeg"
    encoded = base64.b64encode(data).decode("ascii")
    return (
        f'<figure><img src="data:image/{kind};base64,{encoded}" alt="{escape(alt)}">{legend}'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def grid(*figures: str) -> str:
    """Figures beside each other where there is room."""
    return f'<div class="grid">{"".join(figures)}</div>'


def color_bar(colors: Sequence[tuple[int, int, int]], low: str, high: str, label: str) -> str:
    """A bar of colours with its ends and its label, all as text."""
    stops = ", ".join(f"rgb({r} {g} {b})" for r, g, b in colors)
    return (
        f'<div class="bar"><span>{escape(low)}</span><i style="background:linear-gradient(to right, {stops})"></i>'
        f"<span>{escape(high)}</span><span>{escape(label)}</span></div>"
    )


def color_key(colors: Mapping[str, tuple[int, int, int]]) -> str:
    """What fixed colours mean."""
    marks = (
        f'<span><i style="background:rgb({r} {g} {b})"></i> {escape(name)}</span>'
        for name, (r, g, b) in colors.items()
    )
    return f'<div class="bar key">{"".join(marks)}</div>'


def frame(document: str, title: str) -> str:
    """Another page within this one. Its scripts run without access to this one."""
    return f'<iframe title="{escape(title)}" sandbox="allow-scripts" loading="lazy" srcdoc="{escape(document)}"></iframe>'


def folded(summary: str, text: str) -> str:
    """Preformatted text that is shown on demand."""
    return f"<details><summary>{escape(summary)}</summary><pre>{escape(text)}</pre></details>"
