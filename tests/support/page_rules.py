"""What every page of results keeps to: one main part, headings in order, texts for pictures."""

import re
from html.parser import HTMLParser

PICTURES = ("img", "video", "canvas", "svg")


class _Page(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.tags, self.headings, self.open, self.faults = [], [], [], []
        self.pictures, self.text = [], text
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.tags.append((tag, found))
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        if tag in PICTURES:
            self.pictures.append((tag, found))
        if tag == "table" and "wide" not in " ".join(self.open):
            self.faults.append("a table outside of a box that scrolls")
        if tag == "div":
            self.open.append(found.get("class", ""))

    def handle_endtag(self, tag):
        if tag == "div" and self.open:
            self.open.pop()


def faults(text):
    """Rules that a page breaks, as sentences."""
    page = _Page(text)
    tags = [tag for tag, _ in page.tags]
    yield from page.faults
    if tags.count("main") != 1:
        yield f"{tags.count('main')} main parts"
    if not re.match(r'<!doctype html>\s*<html lang="en">', text):
        yield "no language"
    if page.headings[:1] != [1] or page.headings.count(1) != 1:
        yield f"headings begin with {page.headings[:2]}"
    for before, after in zip(page.headings, page.headings[1:], strict=False):
        if after > before + 1:
            yield f"a heading of level {after} follows one of level {before}"
    for tag, found in page.pictures:
        words = found.get("alt") or found.get("aria-label") or ""
        if not re.search(r"\w{3}.*\d|\d.*\w{3}", words, re.DOTALL):
            yield f"{tag} without what is seen: {words!r}"
    ids = [found["id"] for _, found in page.tags if "id" in found]
    for name in {one for one in ids if ids.count(one) > 1}:
        yield f"two elements of the id {name}"
    for name in re.findall(r'href="#([^"]+)"', text):
        if name not in ids:
            yield f"a link to #{name}, which is not there"
    for wide in re.findall(r"(?<![-\w])(?:min-)?width: *([\d.]+)(px|rem)", styles(text)):
        if float(wide[0]) * (16 if wide[1] == "rem" else 1) > 380 and wide != ("40", "rem"):
            yield f"a fixed width of {''.join(wide)}"
    for colours, number in contrasts(text):
        if number < 4.5:
            yield f"contrast of {colours} {number:.2f}"


def styles(text):
    return "\n".join(re.findall(r"<style>(.*?)</style>", text, re.DOTALL))


PAIRS = [
    *((front, "page") for front in ("text", "muted", "link", "pass", "fail")),
    *((front, back) for front in ("text", "link") for back in ("answer", "warning")),
    ("text", "code"),
]


def contrasts(text):
    """Contrast of every pair of colours, in the light and in the dark mode."""
    light, dark = (
        dict(re.findall(r"--(\w+): (#\w+)", block))
        for block in re.findall(r":root \{(.*?)\}", styles(text), re.DOTALL)
    )
    for mode, colours in (("light", light), ("dark", light | dark)):
        for front, back in PAIRS:
            yield f"{mode} {front} on {back}", contrast(colours[front], colours[back])


def contrast(one, other):
    """Contrast ratio of two colours, WCAG 2.2."""
    bright, dim = sorted((luminance(one), luminance(other)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


def luminance(colour):
    """Relative luminance of a colour as #rgb or #rrggbb, WCAG 2.2."""
    digits = colour.lstrip("#")
    digits = "".join(2 * d for d in digits) if len(digits) == 3 else digits
    parts = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
