"""Rules of the house that no linter knows: how long functions are, how many parameters they have.

A function that breaks a rule for a reason is listed here, with the reason.
"""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import chainshaper

SOURCE = Path(chainshaper.__file__).parent
MOST_PARAMETERS, MOST_LINES = 12, 60

ALLOWED_PARAMETERS = {
    "cli/plans.py: plan": "a verb: its parameters are the options of the command line",
    "cli/runs.py: profile": "a verb: its parameters are the options of the command line",
    "cli/runs.py: shape": "a verb: its parameters are the options of the command line",
    "cli/runs.py: watch": "a verb: its parameters are the options of the command line",
    "flow/apply.py: apply_plan": "the public call of a verb: each is an option of `apply`",
    "flow/launch_shaping.py: shape_launch": "the public call of a verb: each is an option of it",
    "flow/record.py: record_command": "the public call of a verb: each is an option of `record`",
}

ALLOWED_LENGTH = {
    "flow/apply.py: apply_plan": "a run from its claim to its end, in order: each line is a step",
    "flow/recorded_profile/chain_profile.py: profile_of": "it makes one value of 37 fields",
}


class Measured(NamedTuple):
    name: str  # "FILE: FUNCTION"
    parameters: int
    lines: int  # of code: neither docstring, nor comments, nor blank lines
    bag: str | None  # the name of what takes all other keyword arguments


def measured_functions() -> Iterator[Measured]:
    for path in sorted(SOURCE.rglob("*.py")):
        text = path.read_text()
        lines = text.splitlines()
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                continue
            arguments = node.args
            parameters = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
            for rest in (arguments.vararg, arguments.kwarg):
                if rest is not None:
                    parameters.append(rest)
            has_docstring = ast.get_docstring(node) is not None and len(node.body) > 1
            first = node.body[1 if has_docstring else 0].lineno
            code = [
                line
                for line in lines[first - 1 : node.end_lineno]
                if line.strip() and not line.strip().startswith("#")
            ]
            bag = None if arguments.kwarg is None else arguments.kwarg.arg
            name = f"{path.relative_to(SOURCE)}: {node.name}"
            yield Measured(name, len(parameters), len(code), bag)


FUNCTIONS = tuple(measured_functions())


def test_no_function_has_more_parameters_than_a_reader_can_hold() -> None:
    many = {function.name for function in FUNCTIONS if function.parameters > MOST_PARAMETERS}
    assert many <= ALLOWED_PARAMETERS.keys(), "give it a value that holds some, or a reason here"


def test_every_function_fits_a_screen() -> None:
    long = {function.name for function in FUNCTIONS if function.lines > MOST_LINES}
    assert long <= ALLOWED_LENGTH.keys(), "cut it where an idea ends, or give a reason here"


def test_parameters_are_named_where_they_are_passed_on() -> None:
    """A bag of keyword arguments (``**how``, ``**limits``) hides what a function takes."""
    bags = {function.name for function in FUNCTIONS if function.bag in ("how", "limits")}
    assert not bags, "name the parameters"
