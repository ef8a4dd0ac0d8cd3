"""A model card as HTML: Markdown without anything that a stranger could use against a reader."""

from __future__ import annotations

import markupsafe
from markdown_it import MarkdownIt

_HEADING_SHIFT = 1
"""A card's first heading stands below the page's own."""
_LOWEST_HEADING = 4


def to_html(text: str) -> markupsafe.Markup:
    """Render Markdown.

    HTML in the text is shown as text, and images as links: nothing is loaded from elsewhere. Links may lead
    to ``http``, ``https`` and ``mailto`` only, and pass on nothing.
    """
    reader = MarkdownIt("commonmark", {"html": False}).enable("table").disable(["image", "html_inline"])
    reader.validateLink = lambda url: url.lower().startswith(("http://", "https://", "mailto:"))
    tokens = reader.parse(text)
    for token in tokens:
        if token.type in ("heading_open", "heading_close"):
            token.tag = f"h{min(int(token.tag[1]) + _HEADING_SHIFT, _LOWEST_HEADING)}"
        for child in token.children or []:
            if child.type == "link_open":
                child.attrSet("rel", "noopener noreferrer nofollow")
    return markupsafe.Markup(reader.renderer.render(tokens, reader.options, {}))
