"""The golden figures notice changes that make answers worse, each by the case meant for it.

``python tools/golden_mutations.py --numbers NAME`` prints every case that notices.
"""

from __future__ import annotations

import contextlib
import copy
import json

import pytest

from tests.scripts import ROOT, load_script

golden_quick = load_script("tools/golden_cases/quick.py")
mutations = load_script("tools/golden_mutations.py")


def ids(value: object) -> str:
    return str(value).replace(" ", "_")


def cases_that_notice() -> list[str]:
    by_behaviour = mutations.BEHAVIOUR_NOTICED_BY.values()
    by_number = (noticed.case for noticed in mutations.NOTICED_BY.values())
    return sorted({*by_behaviour, *by_number})


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "case"), mutations.BEHAVIOUR_NOTICED_BY.items(), ids=ids
)
def test_a_change_of_behaviour_is_noticed(name, case):
    changes = {change.name: change for change in mutations.changes_of_behaviour()}
    assert mutations.noticed_by(changes[name], [case])


@pytest.mark.long
@pytest.mark.parametrize("name", mutations.NOTICED_BY, ids=ids)
def test_a_fitted_number_changed_by_a_third_is_noticed(name):
    direction, case, in_a_copy = mutations.NOTICED_BY[name]
    assert mutations.who_notices(name, direction, [case], in_a_copy)


@pytest.mark.long
@pytest.mark.parametrize("case", cases_that_notice(), ids=ids)
def test_without_a_change_nothing_is_noticed(case):
    """What the tests above find is the change, not a frozen figure that does not hold."""
    nothing = mutations.Change("nothing", contextlib.nullcontext)
    assert mutations.noticed_by(nothing, [case]) == []


def test_every_number_that_is_checked_is_there():
    """A number that has another name now is changed under that name."""
    checked = {*mutations.NOTICED_BY, *mutations.UNNOTICED}
    assert checked <= set(mutations.fitted_numbers())


def test_every_case_that_must_notice_is_frozen():
    frozen = json.loads((ROOT / "docs/golden_quick.json").read_text("utf-8"))
    assert set(cases_that_notice()) <= set(frozen["cases"])
    assert list(frozen["cases"]) == list(golden_quick.cases())


def test_one_number_of_a_source_is_edited():
    text = "A = 0.3\nB = {'x': (3, -4.0)}\n"
    assert mutations.edited(text, "B", ("x", 1), 0.5) == text.replace(
        "-4.0", "-2.0"
    )
    assert mutations.edited(text, "A", (), 2.0) == text.replace("0.3", "0.6")


def test_a_change_is_undone():
    from hybridvo import pipeline
    from hybridvo.judge import calibration

    before = copy.deepcopy(calibration.CUES_RIGHT)
    first_sure = pipeline.first_sure
    with mutations.change_of_number("CUES_RIGHT[0]", 2.0).make():
        assert calibration.CUES_RIGHT != before
    with mutations.answers_changed(mutations.turned):
        assert pipeline.first_sure is not first_sure
    assert calibration.CUES_RIGHT == before
    assert pipeline.first_sure is first_sure
