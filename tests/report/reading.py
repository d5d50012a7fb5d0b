"""Parse a page as a browser would."""

from html.parser import HTMLParser

EMPTY = {"meta", "img", "link", "br", "input", "hr"}


class Page(HTMLParser):
    """Elements with their attributes, text by section, and the pages in frames."""

    def __init__(self, html):
        super().__init__()
        self.elements, self.frames, self.sections, self.stack = [], [], {}, []
        self._section = ""
        self.feed(html)
        self.sections = {name: " ".join(text.split()) for name, text in self.sections.items()}

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.elements.append((tag, found))
        if tag == "section":
            self._section = found["id"]
        if tag == "iframe":
            self.frames.append(Page(found["srcdoc"]))
        if tag not in EMPTY:
            self.stack.append(tag)

    def handle_endtag(self, tag):
        if tag not in EMPTY:
            assert self.stack.pop() == tag

    def handle_data(self, data):
        if self.stack and self.stack[-1] not in ("style", "script"):
            self.sections[self._section] = self.sections.get(self._section, "") + data + " "

    def all(self, tag):
        return [found for name, found in self.elements if name == tag]

    def addresses(self):
        """Addresses in attributes of the page and its frames."""
        names = ("src", "href", "srcset", "poster", "data", "action")
        own = [found[name] for _, found in self.elements for name in names if found.get(name)]
        return own + [address for frame in self.frames for address in frame.addresses()]
