"""Look at the links of the built site: ``python tools/check_links.py build/docs``.

Links within it must lead to a file, and to an anchor that is there. Links that lead away are only looked at: they must be
https addresses of the hosts below, since a test has no network to try them.
"""

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

HOSTS = {"github.com", "pradyunsg.me", "www.sphinx-doc.org"}  # pages of others; the theme and its maker


class Page(HTMLParser):
    """Links and anchors of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = {""}
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("href", "src") and value is not None and tag != "link":
                self.links.append(value)
            elif name == "id" and value is not None:
                self.anchors.add(value)


def main(site: Path) -> list[str]:
    """What is wrong, a line each."""
    pages = {path.resolve(): Page(path) for path in sorted(site.rglob("*.html"))}
    wrong = [] if pages else [f"{site} has no pages"]
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                if parts.scheme != "https" or parts.hostname not in HOSTS:
                    wrong.append(f"{path.name}: {link} is no https address of a known host")
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.exists():
                wrong.append(f"{path.name}: {link} leads nowhere")
            elif target in pages and parts.fragment and unquote(parts.fragment) not in pages[target].anchors:
                wrong.append(f"{path.name}: {link} has no such anchor")
    return sorted(set(wrong))


if __name__ == "__main__":
    found = main(Path(sys.argv[1]))
    print(*found or ["all links within the site lead somewhere"], sep="\n")
    sys.exit(bool(found))
