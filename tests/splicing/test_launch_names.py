"""Texts and names in launch files: substitutions, full names, which remap rule decides."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from launch_cases import PACKAGES

from chainshaper.splicing.launch.actions import RemapRule, Substitution
from chainshaper.splicing.launch.remaps import FullName, PlacedRule, expanded, rules_in_force
from chainshaper.splicing.launch.substitutions import (
    Surroundings,
    described,
    parse_template,
    resolve,
)

NDT = FullName("ndt", "/loc")
HERE = Surroundings({"a": "one", "one": "two", "unknown": None}, Path("/robot/launch/a.launch.xml"))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", ""),
        ("plain $ text", "plain $ text"),
        ("$(var a)", "one"),
        ("x_$(var a)_$(var a)", "x_one_one"),
        ("$(var $(var a))", "two"),
        ("$(var b other)", "other"),
        ("$(var b 'two words')", "two words"),
        ('$(var b "$(var a) too")', "one too"),
        ("$(var b)", None),
        ("$(var unknown default)", None),
        ("$(dirname)/x", "/robot/launch/x"),
        ("$(filename)", "/robot/launch/a.launch.xml"),
        (r"\$(var a)", "$(var a)"),
        (r"a\\b", r"a\b"),
        ("$(env CHAINSHAPER_TEST)", "set"),
        ("$(env CHAINSHAPER_NOT_SET)", None),
        ("$(env CHAINSHAPER_NOT_SET 'x')", "x"),
        ("$(optenv CHAINSHAPER_NOT_SET)", ""),
        ("$(find-pkg-share localizer)/launch", f"{PACKAGES}/share/localizer/launch"),
        ("$(find-pkg-prefix localizer)", str(PACKAGES)),
        ("$(find-pkg-share nowhere)", None),
        ("$(eval '1 + 1')", None),
        ("$(command 'rm -rf $(var a)')", None),
        ("$(var a", None),
        ("$()", None),
        ("$(var 'a)", None),
    ],
)
def test_substitutions_have_the_values_that_launch_gives_them(
    text: str, value: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{PACKAGES}")
    monkeypatch.setenv("CHAINSHAPER_TEST", "set")
    assert resolve(parse_template(text), HERE) == value


def test_a_template_is_shown_as_a_person_writes_it() -> None:
    text = "$(find-pkg-share robot)/launch/$(var kind x).launch.py"
    assert described(parse_template(text)) == text
    joined = Substitution("join", ((Substitution("dirname"),), ("a",), ("b",)))
    assert described((joined,)) == "$(dirname)/a/b"


@given(st.text(alphabet="ab$()'\"\\ var", max_size=30))
def test_no_text_is_too_odd_to_be_parsed(text: str) -> None:
    value = resolve(parse_template(text), HERE)
    assert value is None or isinstance(value, str)


@given(st.text(alphabet="ab_/~ -:.", max_size=30))
def test_a_text_without_substitutions_is_itself(text: str) -> None:
    assert resolve(parse_template(text), HERE) == text


@pytest.mark.parametrize(
    ("name", "full"),
    [
        ("/pose", "/pose"),
        ("pose", "/loc/pose"),
        ("a/pose", "/loc/a/pose"),
        ("~/pose", "/loc/ndt/pose"),
        ("~", "/loc/ndt"),
        ("rostopic://pose", "/loc/pose"),
    ],
)
def test_names_of_topics_are_relative_to_the_node(name: str, full: str) -> None:
    assert expanded(name, NDT) == full


@pytest.mark.parametrize("text", ["/ndt", "/loc/ndt", "/a/b/ndt"])
def test_a_full_name_is_taken_apart_and_put_together(text: str) -> None:
    assert str(FullName.of(text)) == text


def _rules(*pairs: tuple[str | None, str | None]) -> list[PlacedRule]:
    return [PlacedRule(match, target, RemapRule((), (), None)) for match, target in pairs]


def test_the_first_rule_that_matches_counts_and_is_not_matched_again() -> None:
    rules = rules_in_force(
        _rules(("out", "/a"), ("/loc/out", "/b"), ("/a", "/c"), ("~/out", "d")), NDT
    )
    assert [(rule.match, rule.target) for rule in rules] == [
        ("/loc/out", "/a"),
        ("/a", "/c"),
        ("/loc/ndt/out", "/loc/d"),
    ]


def test_rules_of_other_nodes_and_of_names_do_not_count() -> None:
    rules = rules_in_force(
        _rules(("other:out", "/a"), ("__node", "x"), ("ndt:__ns", "/y"), ("ndt:out", "/b")), NDT
    )
    assert [(rule.match, rule.target) for rule in rules] == [("/loc/out", "/b")]


def test_what_is_unknown_of_a_rule_stays_unknown() -> None:
    rules = rules_in_force(_rules((None, "/a"), ("out", None), ("out", "/b")), NDT)
    assert [(rule.match, rule.target) for rule in rules] == [(None, "/a"), ("/loc/out", None)]
