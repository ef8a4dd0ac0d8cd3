"""Plots of the site as SVG that takes the page's text colour, so that it is legible in light and dark."""

import io
import re

import matplotlib as mpl
from matplotlib.figure import Figure

INK = "#123456"
"""Colour of text and axes in a figure; the page's own once it is SVG."""
PALE = "#8a8f98"


def figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches."""
    return Figure(figsize=(width, height), layout="constrained")


def to_svg(drawn: Figure, title: str) -> str:
    """A figure as SVG that can stand in an HTML page.

    Args:
        drawn: the figure.
        title: what it shows, for those who cannot see it.
    """
    for axes in drawn.axes:
        axes.set_facecolor("none")
        axes.tick_params(colors=INK, which="both", labelsize=9)
        for spine in axes.spines.values():
            spine.set_edgecolor(INK)
        for label in (axes.title, axes.xaxis.label, axes.yaxis.label):
            label.set_color(INK)
    buffer = io.StringIO()
    # glyphs as text, no date, ids that depend on the title only: the same figure is the same file
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": title}):
        drawn.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = re.sub(r"<\?xml.*?\?>|<!DOCTYPE.*?>|<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'<svg [^>]*viewBox="([^"]*)"[^>]*>', rf'<svg {_ATTRIBUTES} viewBox="\1">', text, count=1)
    text = text.replace(INK, "currentColor").replace("<defs>", f"<title>{title}</title>\n <defs>", 1)
    # a blank line would end the block of HTML in Markdown
    return re.sub(r"\n\s*\n", "\n", text.strip()) + "\n"


_ATTRIBUTES = (
    'class="figure" role="img" xmlns="http://www.w3.org/2000/svg" '
    'xmlns:xlink="http://www.w3.org/1999/xlink" font-family="sans-serif" width="100%"'
)
