"""The documentation as a site: ``make docs`` builds it in site/, readable offline.

The pages are the Markdown files beside this one, as they stand; formulas become MathML, which
browsers draw by themselves.
"""

import html
import json
import re
import runpy
import unicodedata
from importlib import metadata
from itertools import pairwise
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert
from PIL import Image

from lidar_mi.io.images import panel_cuts

project = "lidar-mi"
author = "The lidar-mi developers"
copyright = "2026, the lidar-mi developers"
release = metadata.version("lidar-mi")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]

# as docstrings are written: numpydoc, shapes and units in words
# attributes as fields: two classes may have one of the same name
napoleon_use_ivar = True
napoleon_google_docstring = False
napoleon_use_rtype = False
autodoc_typehints = "none"
autodoc_class_signature = "separated"
autodoc_inherit_docstrings = False
source_suffix = {".md": "markdown"}

# as GitHub reads the same files
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]
myst_heading_anchors = 4

html_theme = "furo"
html_title = f"lidar-mi {release}"
html_static_path = ["_static"]
html_css_files = ["narrow.css"]
# with excerpts of its own, also of a site that is opened as files
html_search_scorer = str(Path(__file__).with_name("search.js"))
html_show_search_summary = False
html_copy_source = False
html_show_sphinx = False
# contrasts of 4.5 and more, which those of furo have not
pygments_style = "a11y-high-contrast-light"
pygments_dark_style = "a11y-high-contrast-dark"
html_math_renderer = "mathml"
html_theme_options = {"navigation_with_keys": True}


def _inline(writer, node):
    writer.body.append(_mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def _block(writer, node):
    drawn = _mathml(node.astext(), "block")
    # wider than a small screen: the formula scrolls, not the page
    writer.body.append(f'<div class="math-wrapper"><div class="math">{drawn}</div></div>')
    raise nodes.SkipNode


def _mathml(formula, display):
    """A formula, its source kept for those who copy it."""
    drawn = convert(formula, display=display)
    # browsers know of styled letters only as characters of their own
    drawn = re.sub(r'<mi mathvariant="(bold|script|bold-italic)">([^<]+)</mi>', _styled, drawn)
    return drawn.replace("<math ", f'<math title="{html.escape(formula.strip())}" ', 1)


def _styled(found):
    style, letter = found[1].upper().replace("-", " "), unicodedata.name(html.unescape(found[2]))
    letter = re.sub("LATIN |GREEK |LUNATE |LETTER ", "", letter)
    return f"<mi>{unicodedata.lookup(f'MATHEMATICAL {style} {letter}')}</mi>"


def _write_pages(app):
    """Those that are made from the code and from stored results."""
    runpy.run_path(str(Path(app.srcdir) / "make_pages.py"), run_name="__main__")


def _finish_page(app, name, template, context, doctree):
    """The search page has the texts of all pages; keys may end a line after their dots."""
    if name == "search":
        app.add_js_file("pages.js", priority=400)
    if "body" in context:
        context["body"] = breakable(context["body"])


def breakable(body):
    """Places after dots and underscores of keys at which a line may end, and nowhere else."""
    return re.sub(
        r'(?<=<span class="pre">)[\w.]+(?=</span>)',
        lambda key: re.sub(r"(?<=\w)([._])(?=[^\W\d])", r"\1<wbr>", key[0]),
        body,
    )


def _text(page):
    """What a page says, without its comments."""
    for comment in [*page.findall(nodes.comment), *page.findall(nodes.raw)]:
        comment.parent.remove(comment)
    return " ".join(page.astext().split())


def _write_texts(app, error):
    """The texts that the search page loads."""
    if error or app.builder.format != "html":
        return
    names = sorted(app.env.found_docs)
    texts = {name: _text(app.env.get_doctree(name)) for name in names}
    script = f"const PAGE_TEXTS = {json.dumps(texts, ensure_ascii=False)};\n"
    (Path(app.outdir) / "_static" / "pages.js").write_text(script, encoding="utf-8")


def stacked(path):
    """The panels of a picture one below the other; None: it has one column."""
    cuts = panel_cuts(path)
    if not cuts:
        return None
    with Image.open(path) as image:
        whole = image.convert("RGB")
    edges = [round(cut * whole.width) for cut in (0, *cuts, 1)]
    panels = [whole.crop((a, 0, b, whole.height)) for a, b in pairwise(edges)]
    column = Image.new("RGB", (max(p.width for p in panels), whole.height * len(panels)), "white")
    for number, panel in enumerate(panels):
        column.paste(panel, (0, number * whole.height))
    return column


def _stack_pictures(app, error):
    """Pictures of several columns have their panels stacked on a small screen."""
    if error or app.builder.format != "html":
        return
    out, narrow = Path(app.outdir), {}
    for path in (out / "_images").glob("*.png"):
        column = stacked(path)
        if column is not None:
            narrow[path.name] = f"{path.stem}.narrow.webp"
            column.save(path.with_name(narrow[path.name]), lossless=True)
    for page in out.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        found = with_narrow(text, narrow)
        if found != text:
            page.write_text(found, encoding="utf-8")


def with_narrow(text, narrow):
    """A page whose pictures have other files on a small screen, by their names."""

    def both(image):
        if image["name"] not in narrow:
            return image[0]
        file = image["folder"] + narrow[image["name"]]
        source = f'<source media="(max-width: 46em)" srcset="{file}">'
        return f"<picture>{source}{image[0]}</picture>"

    pattern = r'<img [^>]*src="(?P<folder>[^"]*_images/)(?P<name>[^"/]+)"[^>]*>'
    return re.sub(pattern, both, text)


def setup(app):
    """Formulas of the pages in MathML, and pages that the site alone has."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.connect("builder-inited", _write_pages)
    app.connect("html-page-context", _finish_page)
    app.connect("build-finished", _write_texts)
    app.connect("build-finished", _stack_pictures)
