"""Hooks of mkdocs: equations become MathML when the site is built, so that a page fetches nothing to show them."""

import re
from typing import Any

from latex2mathml.converter import convert

BLOCK = re.compile(r"^\$\$(.+?)\$\$$", re.M | re.S)
INLINE = re.compile(r"\\\((.+?)\\\)")
SOURCE = re.compile(r"\[([^\]]+)\]\(\.\./[^)]+\)")  # a link out of docs/, into the source tree: its text names the file
CODE = re.compile(r"(^```.*?^```$|`[^`\n]*`)", re.M | re.S)


def on_page_markdown(markdown: str, **about: Any) -> str:
    """Return a page's text with its equations as MathML, and without links into the source tree."""
    parts = CODE.split(markdown)
    parts[::2] = [_shown(part) for part in parts[::2]]
    return SOURCE.sub(r"\1", "".join(parts))


def _shown(text: str) -> str:
    text = BLOCK.sub(lambda m: convert(m[1].strip(), display="block").replace("\n", " "), text)
    return INLINE.sub(lambda m: f"<span>{convert(m[1].strip())}</span>", text)  # a bare one at a line begins a block
