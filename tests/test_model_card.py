"""Model cards of strangers as HTML: what they may say, and what never gets through."""

import re

import pytest

from hipg_bench.leaderboard.model_card import to_html


def test_markdown_becomes_html():
    made = to_html("# A team\n\nIt is *good*, see `a < b`.\n\n| a | b |\n|---|---|\n| 1 | 2 |\n")
    assert "<h2>A team</h2>" in made
    assert "<em>good</em>" in made
    assert "<code>a &lt; b</code>" in made
    assert "<td>1</td>" in made


@pytest.mark.parametrize(
    "text",
    [
        "<script>alert(1)</script>",
        "a <img src=x onerror=alert(1)> b",
        "<div onclick=alert(1)>\n\ntext\n\n</div>",
        "[a](javascript:alert(1))",
        "[a](JaVaScRiPt:alert(1))",
        "[a](data:text/html;base64,xxxx)",
        "[a](&#106;avascript:alert(1))",
        "<javascript:alert(1)>",
        "[a]: javascript:alert(1)\n\n[a]",
        "![a](https://example.com/pixel.png)",
        "[a](//example.com)",
        "[a](file:///etc/passwd)",
        '[a](https://example.com "x" onmouseover=alert(1) y")',
        "```js\n</code></pre><script>alert(1)</script>\n```",
    ],
)
def test_nothing_runs_loads_or_leads_elsewhere(text):
    made = to_html(text)
    tags = re.findall(r"<\s*/?\s*([a-z0-9]+)([^>]*)>", made)
    assert {name for name, _ in tags} <= {"p", "a", "pre", "code"}
    for name, attributes in tags:
        if name == "a" and attributes:
            assert re.fullmatch(
                r' href="https://example\.com[^"]*"( title="[^"<>]*")? rel="noopener noreferrer nofollow"',
                attributes,
            )
        elif attributes:
            assert attributes == ' class="language-js"'


def test_headings_stay_below_the_page_s_own():
    assert re.findall(r"<h(\d)>", to_html("# a\n## b\n##### c\n")) == ["2", "3", "4"]
