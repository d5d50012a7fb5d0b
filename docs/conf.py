"""The site: ``sphinx-build -W --keep-going docs build/docs``, and build/docs/index.html is its first page."""

import os
import re
from pathlib import Path

import radarsdf
from sphinx.application import Sphinx
from sphinx.ext.napoleon.docstring import NumpyDocstring

project = "radarsdf"
author = "the radarsdf authors"
project_copyright = f"2026 {author}"
release = version = radarsdf.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"radarsdf {release}"
html_static_path = ["_static"]
html_css_files = ["tables.css"]
html_show_sphinx = False
html_copy_source = False

# Links as GitHub knows them: to files, and to headings by their words.
myst_heading_anchors = 3

# Signatures in one line are unreadable; the docstrings have the types too.
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_rtype = False
python_maximum_signature_line_length = 100

# Of an attribute, napoleon would take what stands before the first colon for its type.
NumpyDocstring._consume_inline_attribute = lambda self: ("", self._dedent(self._consume_to_end()))

DOCS = Path(__file__).parent
# A page that begins so has the text of another file, and then its own. The second line is for readers on GitHub.
_WHOLE = re.compile(r"<!-- the text of (\S+) -->\n\n.*\n")
_LINK = re.compile(r"\[([^][]*)\]\(([^)#\s:]+)(#[^)\s]*)?\)")


def _whole_files() -> dict[Path, Path]:
    """The page of each file outside this folder that is one."""
    found = {}
    for page in DOCS.glob("*.md"):
        if match := _WHOLE.match(page.read_text(encoding="utf-8")):
            found[(DOCS / match[1]).resolve()] = page
    return found


def _read(_: Sphinx, name: str, source: list[str]) -> None:
    """Put in the text of another file, and let links to such files lead to their pages. Files without one are named."""
    pages, page = _whole_files(), DOCS / f"{name}.md"
    file, text = page, source[0]
    if match := _WHOLE.match(text):
        file = (DOCS / match[1]).resolve()
        text = file.read_text(encoding="utf-8") + text[match.end() :]

    def there(link: re.Match[str]) -> str:
        target = (file.parent / link[2]).resolve()
        target = pages.get(target, target)
        if target.is_file() and not target.is_relative_to(DOCS):
            return f"{link[1]} (`{target.relative_to(DOCS.parent).as_posix()}`)"
        return f"[{link[1]}]({Path(os.path.relpath(target, page.parent)).as_posix()}{link[3] or ''})"

    source[0] = _LINK.sub(there, text)


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", _read)
