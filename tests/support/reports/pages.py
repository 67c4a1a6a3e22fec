"""Pages as a browser meets them: elements, whether each is closed, and the text that is read."""

from html.parser import HTMLParser

VOID = {"meta", "img", "br", "link", "hr", "input"}


class Elements(HTMLParser):
    """Elements of a page in their order, handlers of events and scripts in links, and texts.

    Attributes
    ----------
    elements
        Name and attributes of each.
    handlers
        Attributes that would run something.
    text
        What is read outside scripts and styles.
    texts
        The text of each element by its id, or by its name where it has none.
    open
        Elements that were never closed.
    """

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.handlers: list[str] = []
        self.open: list[str] = []
        self.texts: dict[str, str] = {}
        self.text = ""
        self.feed(page)

    @property
    def tags(self) -> list[str]:
        return [tag for tag, _ in self.elements]

    def all(self, tag: str) -> list[dict[str, str | None]]:
        """Attributes of the elements of a name."""
        return [attributes for name, attributes in self.elements if name == tag]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self.handlers += [name for name, value in attrs if name.startswith("on") or _runs(name, value or "")]
        self.open += [] if tag in VOID else [tag]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"{tag} closes another element"

    def handle_data(self, data: str) -> None:
        if self.open:
            tag, attributes = next(each for each in reversed(self.elements) if each[0] == self.open[-1])
            name = attributes.get("id") or tag
            self.texts[name] = self.texts.get(name, "") + data
            self.text += "" if tag in ("style", "script") else data


def _runs(name: str, value: str) -> bool:
    return name in ("href", "src") and "script:" in value
