"""`plan_recording` takes the fields of a request as keyword arguments."""

from dataclasses import fields
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from chainshaper import (
    InputError,
    PlanRequest,
    Recording,
    load_application,
    plan_recording,
    simulate,
)
from chainshaper.planning.request import RequestKeywords
from chainshaper.values.plan_choices import Wishes, WishKeywords

EXAMPLE = Path(__file__).parents[2] / "examples" / "synthetic_chain.yaml"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return simulate(load_application(EXAMPLE), tmp_path_factory.mktemp("runs") / "before", seed=1)


def test_keywords_have_the_names_and_types_of_the_wishes() -> None:
    wished = {field.name: get_args(field.type)[0] for field in fields(Wishes)}
    assert get_type_hints(WishKeywords) == wished
    assert {*get_type_hints(RequestKeywords)} == {field.name for field in fields(PlanRequest)}


def test_keywords_are_fields_of_the_request(recording: Recording) -> None:
    by_keyword = plan_recording(recording, bands=3, grid_ns=10_000)
    assert by_keyword == plan_recording(recording, request=PlanRequest(bands=3, grid_ns=10_000))
    assert len(by_keyword.chains[0].predicted.shares) == 3
    refined = plan_recording(recording, request=PlanRequest(bands=3), grid_ns=10_000)
    assert refined == by_keyword, "a keyword goes before the request's own field"


def test_an_unknown_keyword_is_refused_by_its_name(recording: Recording) -> None:
    with pytest.raises(InputError, match=r"no field 'band': did you mean bands\?"):
        plan_recording(recording, band=3)  # type: ignore[call-arg]
    with pytest.raises(InputError, match=r"no field 'zzz': there are policy, "):
        plan_recording(recording, zzz=3)  # type: ignore[call-arg]


def test_a_plan_and_its_recording_are_shown_in_a_line(recording: Recording) -> None:
    plan = plan_recording(recording)
    assert str(plan) == repr(plan)
    assert repr(plan).startswith("Plan(/t1../t5: shaped, cycle ")
    assert repr(plan.chains[0]).startswith("ChainPlan(/t1../t5: shaped, cycle ")
    assert repr(recording).startswith(f"Recording({recording.path}: simulated on ")
    for value in (plan, recording):
        assert "\n" not in repr(value)
