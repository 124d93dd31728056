"""The page around the data: one file, which no text of a recording can break out of and which asks no network.

The page's own script and style are let in by their digests; everything else is forbidden by the policy in its head.
"""

from __future__ import annotations

import base64
import hashlib
import html
from functools import cache
from importlib.resources import files

SCRIPTS = ("data.js", "colours.js", "planes.js", "space.js", "curves.js", "text.js", "page.js")


def page(title: str, note: str, data: str) -> bytes:
    """The page.

    Args:
        title: of the page, any text.
        note: that stands on top of it.
        data: JSON.
    """
    script, style = "\n".join(_part(name) for name in SCRIPTS), _part("style.css")
    policy = f"default-src 'none'; script-src {_digest(script)}; style-src {_digest(style)}; img-src data:"
    # within <script> only "<" can end the data or open a comment; JSON may spell it as an escape
    safe = data.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
    parts = {
        "POLICY": html.escape(policy, quote=True).replace("&#x27;", "'"),
        "TITLE": html.escape(title),
        "NOTE": html.escape(note),
        "STYLE": style,
        "SCRIPT": script,
        "DATA": safe,
    }
    first, *rest = _part("page.html").split("{{")
    text = [first]
    for piece in rest:  # each place once, so that no part is looked at again for places
        name, after = piece.split("}}", 1)
        text += [parts[name], after]
    return "".join(text).encode("utf-8", "replace")


def _digest(content: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"


@cache
def _part(name: str) -> str:
    return (files(__package__) / "page" / name).read_text(encoding="utf-8").strip()
