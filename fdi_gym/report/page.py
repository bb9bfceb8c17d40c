"""The page of a report: one HTML file with its style, its scripts and its data, and no way to reach a network."""

from __future__ import annotations

import base64
import hashlib
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import msgspec

from fdi_gym import palette

LARGEST = 10_000_000  # bytes of a report
SCRIPTS = ("elements", "table", "plot", "comparison", "confusion", "curves", "flight", "main")


def html(title: str, data: dict[str, Any]) -> str:
    """The page. Data cannot end its element, whatever is in it, and no script but ours runs.

    Args:
        title: Of the page.
        data: What the scripts show: plain data.
    """
    folder = files("fdi_gym.report")
    read = lambda name: (folder / "template" / name).read_text(encoding="utf-8")  # noqa: E731
    script = '(() => {\n"use strict";\n' + "\n".join(read(f"{name}.js") for name in SCRIPTS) + "})();\n"
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return Template(read("page.html")).substitute(
        title=escape(title), style=_colours() + read("style.css"), digest=digest, data=embedded(data), script=script
    )


def embedded(data: Any) -> str:
    """JSON that stays data within HTML: no "<", ">" or "&" stands in it, and no line ends that scripts know and JSON not."""
    text = msgspec.json.encode(data).decode()
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _colours() -> str:
    """The palette as custom properties and classes of lines."""
    values = "".join(f"--c{i}: {colour}; " for i, colour in enumerate(palette.LINES))
    lines = []
    for i in range(len(palette.LINES) * 2):
        colour, dashes = palette.line(i)
        dash = f" stroke-dasharray: {' '.join(map(str, dashes))};" if dashes else ""
        place = palette.LINES.index(colour)
        lines.append(f".l{i} {{ stroke: var(--c{place});{dash} }} .f{i} {{ fill: var(--c{place}); }}")
    return ":root { " + values + "}\n" + "\n".join(lines) + "\n"
