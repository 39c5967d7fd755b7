"""Equations of the site as MathML, made when it is built: a browser shows them and fetches nothing.

A hook of mkdocs. pymdownx.arithmatex (generic) marks what stands between dollars; latex2mathml translates it.
"""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

_MARKED = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def mathml(formula: str, display: str = "inline") -> str:
    """One formula as a `<math>` element.

    Args:
        formula: LaTeX, without dollars.
        display: `inline` or `block`.

    Raises:
        PluginError: LaTeX that latex2mathml does not know; it would print it as it stands.
    """
    try:
        found = str(convert(formula, display=display))
    except Exception as error:
        raise PluginError(
            f"mathml.formula: expected LaTeX that latex2mathml knows, got {formula!r}: {error}"
        ) from error
    unknown = re.findall(r"\\[A-Za-z]+", html.unescape(re.sub(r"<[^>]*>", " ", found)))
    if unknown:
        raise PluginError(f"mathml.formula: latex2mathml does not know {unknown} in {formula!r}.")
    return found


def on_page_content(content: str, **told: Any) -> str:
    """The page with every marked formula as MathML. Mkdocs calls it with page, config and files beside the content."""
    return _MARKED.sub(lambda m: mathml(html.unescape(m[3]).strip(), "block" if m[2] == "[" else "inline"), content)
