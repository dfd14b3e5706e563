"""The tables of mutants: each mutant still applies, and its tests still exist."""

import mutants


def test_every_mutant_changes_one_place_and_names_tests_that_exist():
    rows = mutants.read_mutants()
    assert rows
    assert {row.name: why for row in rows if (why := mutants.why_invalid(row))} == {}
    assert len({row.name for row in rows}) == len(rows)


def test_only_a_test_that_fails_kills_a_mutant():
    verdicts = {
        "killed": [(1, "FAILED tests/a.py::test - assert 1 == 2")],
        "survivor": [(0, "3 passed")],
        "error": [
            (None, ""),
            (0, "3 skipped"),
            (1, "ERROR tests/a.py::test - ValueError"),
            (1, "FAILED tests/a.py::test - NameError: name 'x' is not defined"),
            (2, "FAILED tests/a.py::test - assert 1 == 2"),
            (4, "ERROR: not found"),
            (5, "no tests ran"),
        ],
    }
    for verdict, runs in verdicts.items():
        assert [mutants.verdict(code, output)[0] for code, output in runs] == [verdict] * len(runs)
