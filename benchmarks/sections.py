"""Pages of sections, each written by its own run, and shares as they print them."""

from scipy.stats import binomtest


def share(hits):
    """A share in percent with its interval (Clopper and Pearson)."""
    low, high = binomtest(int(hits.sum()), hits.size).proportion_ci(0.95)
    return f"{100 * hits.mean():.0f} ({100 * low:.0f}-{100 * high:.0f})"


def sections_of(page):
    """What a page says of each plant, suite or whatever its sections are about."""
    parts = page.read_text().split("\n## ")[1:] if page is not None and page.is_file() else []
    return {name: text.strip() for name, text in (part.split("\n", 1) for part in parts)}


def write_sections(page, introduction, sections):
    """The page: what it is about, and its sections by name."""
    parts = [introduction, *(f"\n## {name}\n\n{text}" for name, text in sorted(sections.items()))]
    page.write_text("\n".join(parts).rstrip() + "\n")
