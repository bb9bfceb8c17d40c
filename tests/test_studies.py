"""The studies that show what holds: what they draw, and what they call too much."""

import ast

import numpy as np
import scipy.stats
from conftest import ROOT

from benchmarks import gaps, mutants


def applied(text):
    """Each change of a text as the study applies it: to the bytes of the file."""
    source = text.encode()
    for mutant in mutants.of_source("any.py", source):
        yield (source[: mutant.start] + mutant.after.encode() + source[mutant.stop :]).decode()


def test_a_mutant_is_one_change_and_what_computes_nothing_stays():
    for text, expected in {
        "a + b * c": {"a - b * c", "a + b / c"}, "x -= y": {"x += y"}, "a < b <= c": {"a >= b <= c", "a < b > c"},
        "f(a, axis=1)": set(), "f(a, 1)": {"f(a, -1)"}, "f(a, -1)": {"f(a, 1)"}, "x = 0": set(), "not a": {"a"},
        "y = True": {"y = False"}, "a and b": {"a or b"}, "a if b else c": {"a if not b else c"},
        "def f(x: int | None = 2) -> 3:\n    raise ValueError(f'{x + 1}')": {
            "def f(x: int | None=-2) -> 3:\n    raise ValueError(f'{x + 1}')"
        },
    }.items():  # fmt: skip
        found = [ast.unparse(ast.parse(done)) for done in applied(text)]
        assert set(found) == {ast.unparse(ast.parse(e)) for e in expected}, text
        assert len(found) == len(expected), text


def test_mutants_are_drawn_again_by_their_seed_and_each_changes_what_its_file_says():
    drawn = mutants.draw(3, 20)
    assert drawn == mutants.draw(3, 20)
    assert len({(m.file, m.start, m.after) for m in drawn}) == 20
    for mutant in drawn:
        source = (ROOT / mutant.file).read_bytes()
        after = source[: mutant.start] + mutant.after.encode() + source[mutant.stop :]
        assert ast.dump(ast.parse(after)) != ast.dump(ast.parse(source))
        assert mutant.tests
        assert all((ROOT / tests.partition(" -k ")[0]).exists() for tests in mutant.tests)


def test_gaps_take_what_they_say_and_nothing_else():
    obs = np.random.default_rng(0).normal(size=(2, 400, 5))
    found = gaps.with_gaps(obs, 3)
    assert set(found) == {"whole", *(str(n) for n in gaps.GAPS), "every seventh", "sample 0", "all"}
    for pattern, flights in found.items():
        gone = np.isnan(flights)
        assert np.array_equal(flights[~gone], obs[~gone]), pattern
        assert np.array_equal(gone[0], gone[1]), pattern
        empty = gone[0].all(axis=1)
        assert empty.sum() == {"whole": 0, "every seventh": 0, "sample 0": 1, "all": 1 + sum(gaps.GAPS)}.get(
            pattern, 3 * int(pattern) if pattern.isdigit() else None
        )
    alone = np.isnan(found["every seventh"][0])
    assert alone.sum() == len(range(0, 400, 7)) == alone[::7, 1].sum()


def test_most_is_the_binomial_quantile():
    for flights, rate in ((40, 0.05), (12, 0.05), (40, 0.575), (6, 0.0)):
        assert gaps.most(flights, rate) == scipy.stats.binom.ppf(0.975, flights, rate).clip(0)
