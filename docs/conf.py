"""The site: ``sphinx-build -W --keep-going docs build/docs``, and build/docs/index.html is its first page."""

import os
import re
from pathlib import Path

import radarsdf
from sphinx.application import Sphinx
from sphinx.ext.napoleon.docstring import NumpyDocstring
from sphinx_gallery.sorting import ExplicitOrder

project = "radarsdf"
author = "the radarsdf authors"
project_copyright = f"2026 {author}"
release = version = radarsdf.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_gallery.gen_gallery"]
exclude_patterns = ["gallery"]  # the scripts; their pages are in auto_gallery
html_theme = "furo"
html_title = f"radarsdf {release}"
html_static_path = ["_static"]
html_css_files = ["tables.css"]
html_show_sphinx = False
html_copy_source = False

# The scripts run while the site is built; one that fails is an error.
GALLERY = (
    "map_a_drive", "find_faults", "novel_views", "poses", "live_map",
    "locate", "detect_changes", "plan_with_distances", "calibrate_radars", "tiles",
)  # fmt: skip
sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "auto_gallery",
    "filename_pattern": r"\.py$",
    "within_subsection_order": ExplicitOrder([f"{name}.py" for name in GALLERY]),
    "abort_on_example_error": True,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "show_signature": False,
    "write_computation_times": False,
}

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
# A link to a script of the gallery that is a paragraph of its own becomes the script's first picture.
_PICTURE = re.compile(r"^\[([^][]+)\]\(gallery/(\w+)\.py\)$", re.MULTILINE)
_LINK = re.compile(r"\[([^][]*)\]\(([^)#\s:]+)(#[^)\s]*)?\)")


def _whole_files() -> dict[Path, Path]:
    """The page of each file, and of the folder of the gallery, that is one."""
    found = {DOCS / "gallery": DOCS / "auto_gallery" / "index.rst"}
    found |= {
        script: DOCS / "auto_gallery" / f"{script.stem}.rst" for script in (DOCS / "gallery").glob("*.py")
    }
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

    text = _PICTURE.sub(r"[![\1](auto_gallery/images/sphx_glr_\2_001.png)](auto_gallery/\2.rst)", text)
    source[0] = _LINK.sub(there, text)


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", _read)
