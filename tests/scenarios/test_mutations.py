"""A short form of `safety_mutations`; `make safety` goes through thousands of cases."""

from __future__ import annotations

from safety_mutations import as_ordinary_user

CASES = 25


def test_no_mutated_summary_ends_in_a_traceback_or_passes_a_false_verdict() -> None:
    counts = as_ordinary_user("summaries", CASES)
    assert counts.pop("cases") == CASES
    assert counts.pop("refused") > CASES // 2
    assert counts == {"tracebacks": 0, "false_verdicts": 0, "wrong_answers": 0}


def test_no_damaged_campaign_ends_in_a_traceback() -> None:
    counts = as_ordinary_user("campaigns", CASES)
    assert counts.pop("cases") == CASES
    assert counts.pop("refused") > CASES // 3
    assert counts == {"tracebacks": 0, "false_verdicts": 0, "wrong_answers": 0}
