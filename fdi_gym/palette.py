"""Colours and line styles that everybody can tell apart, for all pictures.

Okabe, M., Ito, K. (2008), Color Universal Design. Lines differ in their dashes too: in print, and in one's own eyes, a
colour may be lost. The truth is always ink, drawn above what is said about it.
"""

from __future__ import annotations

INK = "#000000"
SHADE = "#E8E4DA"  # where a fault acts
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A7A7A")
DASHES: tuple[tuple[float, ...], ...] = ((), (6, 2), (2, 1.5), (6, 2, 1.5, 2), (9, 3), (4, 1.5, 1.5, 1.5, 1.5, 1.5), (1, 1))


def line(i: int) -> tuple[str, tuple[float, ...]]:
    """Colour and dashes (on, off, ... in line widths; empty for a solid line) of the i-th of the lines of a picture.

    The dashes of a second round of the colours are others.
    """
    return LINES[i % len(LINES)], DASHES[(i + i // len(LINES)) % len(DASHES)]
