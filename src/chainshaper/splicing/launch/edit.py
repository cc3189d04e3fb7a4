"""The texts of the copies: every change as near to its node as can be done without doubt.

A change goes to the node itself, or to the rule that decides for it. All files on the way from the
launch file to there are copied too, because each must include the copy of the next; a file that is
included twice gets a copy for the one place that is meant. Where one of them cannot be edited
safely, the rule, bound to the node's name, goes to the beginning of the launch file. A Python file
is then left alone and included by a new one that adds the rule.
"""

import difflib
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

from chainshaper.splicing.launch.actions import (
    Edit,
    Include,
    LaunchFile,
    NodeAction,
    Span,
    apply_edits,
    flattened,
)
from chainshaper.splicing.launch.file import LANGUAGES, read_text
from chainshaper.splicing.launch.substitutions import described
from chainshaper.splicing.launch.targets import (
    Remedy,
    Wanted,
    heard_by_owner,
    notes_of_bound_rule,
    remedies_for,
)
from chainshaper.splicing.launch.walk import Walk
from chainshaper.splicing.launch.wrapping import wrapper_text
from chainshaper.splicing.shaping_process import ShapingProcess
from chainshaper.values.errors import InputError, OperationError

__all__ = ["Copies", "Copy", "edited_copies", "unified_diff"]


@dataclass(frozen=True)
class Copy:
    """A file to write: its name in the folder, its text, and the file that it replaces.

    ``before`` is that file's text; empty where the file is new and includes the original.
    """

    name: str
    text: str
    original: Path
    before: str


@dataclass(frozen=True)
class Copies:
    """All files to write; ``launch`` maps each launch file to the one to launch instead."""

    files: tuple[Copy, ...]
    launch: Mapping[Path, str]
    notes: tuple[str, ...]


@dataclass
class _Work:
    """Edits per instance of a launch file, and remaps per instance and node's place.

    For launch files themselves also the rules and nodes that are to stand at their start.
    """

    edits: dict[int, list[Edit]] = field(default_factory=lambda: defaultdict(list))
    remaps: dict[tuple[int, int], tuple[object, list[tuple[str, str]]]] = field(
        default_factory=dict
    )
    rules: dict[int, list[tuple[str, str]]] = field(default_factory=lambda: defaultdict(list))
    starts: dict[int, list[ShapingProcess]] = field(default_factory=lambda: defaultdict(list))
    places: dict[int, Counter[object]] = field(default_factory=dict)
    copyable: dict[int, bool] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def edited_copies(
    walk: Walk, wanted: Sequence[tuple[Wanted, ShapingProcess]], folder: Path
) -> Copies:
    """Copies of launch files that start these nodes, and remap what these stand behind or before.

    ``folder`` is where the copies will stand. A process that several remaps are for starts once.

    Raises:
        InputError: a node is not there, or twice, or remapped otherwise.
        OperationError: a remap can only be changed by hand.
    """
    work = _Work()
    for want, process in wanted:
        _refuse_taken_name(walk, process)
        remedies, notes = remedies_for(walk, want)
        work.notes += notes
        if not any(process in started for started in work.starts.values()):
            starts = work.starts[_root(walk, remedies[0].instance)]
            starts += [process] if process.standby is None else [process, process.standby]
        for remedy in remedies:
            _apply(walk, work, remedy)
    _edits_of_nodes(walk, work)
    work.notes += [
        f"{walk.instances[number].file.path}:{include.line}: left as it is, because the file it"
        f" includes was not found: {described(include.path)}"
        for number, include in walk.not_followed
    ]
    return _written(walk, work, folder)


def _refuse_taken_name(walk: Walk, process: ShapingProcess) -> None:
    for node in walk.nodes:
        if node.name == process.name and node.namespace in ("", process.namespace):
            raise InputError(
                f"{walk.instances[node.instance].file.path}:{node.action.line}: a node"
                f" {process.name} is there already, the name of the one to be added: rename it"
            )


def _apply(walk: Walk, work: _Work, remedy: Remedy) -> None:
    """Put one change where it belongs, or at the beginning of the launch file."""
    number = remedy.instance
    if _reachable(walk, work, number) and _near(work, walk.instances[number].file, remedy):
        return
    heard_by_owner(walk, remedy)
    root = _root(walk, number)
    if remedy.bound not in work.rules[root]:
        work.rules[root].append(remedy.bound)
    work.notes += notes_of_bound_rule(walk, remedy)


def _near(work: _Work, file: LaunchFile, remedy: Remedy) -> bool:
    """Change the node, or the rule that decides for it, if that is safe."""
    language, rule, node = LANGUAGES[file.language], remedy.rule, remedy.node
    edits: list[Edit] | None = None
    if rule is not None and rule.scope is not None:
        place: object = rule.scope[1].place
        if place is not None and _once(work, file, place):
            edits = language.add_set_remaps(file, place, [remedy.bound])
    elif rule is not None and remedy.sure:
        if rule.rule.span is not None and _once(work, file, rule.rule.span):
            edits = [language.replaced(file, rule.rule.span, remedy.wanted.target)]
    elif node is not None and remedy.near and not (rule is not None and rule.from_arguments):
        added = (remedy.match, remedy.wanted.target) if remedy.sure else remedy.bound
        place = node.action.place
        if place is None or not _once(work, file, place):
            return False
        if language.add_remaps(file, place, [added]) is None:
            return False
        _, remaps = work.remaps.setdefault((remedy.instance, id(place)), (place, []))
        remaps += [added] if added not in remaps else []
        return True
    known = work.edits[remedy.instance]
    known += [edit for edit in edits or () if edit not in known]
    return edits is not None


def _edits_of_nodes(walk: Walk, work: _Work) -> None:
    """Turn remaps for nodes into edits, one for each node."""
    for (number, _), (place, rules) in work.remaps.items():
        file = walk.instances[number].file
        work.edits[number] += LANGUAGES[file.language].add_remaps(file, place, rules) or []


def _once(work: _Work, file: LaunchFile, place: object) -> bool:
    """Whether one action alone stands at a place: a loop's node stands for several."""
    if id(file) not in work.places:
        work.places[id(file)] = _places(file)
    return work.places[id(file)][place if isinstance(place, Span) else id(place)] == 1


def _places(file: LaunchFile) -> Counter[object]:
    """How many actions stand at each place."""
    places: Counter[object] = Counter()
    for action in {id(action): action for action in flattened(file.actions)}.values():
        if isinstance(action, NodeAction):
            places[id(action.place)] += 1
            places.update(rule.span for rule in action.rules)
        elif isinstance(action, Include):
            places[action.span] += 1
        elif hasattr(action, "place"):
            places[id(action.place)] += 1
    return places


def _reachable(walk: Walk, work: _Work, number: int) -> bool:
    """Whether a copy can be made, and included by copies up to the launch file."""
    instance = walk.instances[number]
    file = instance.file
    if id(file) not in work.copyable:
        work.copyable[id(file)] = LANGUAGES[file.language].keep_folder(file) is not None
    if not work.copyable[id(file)]:
        return False
    if instance.parent is None or instance.include is None:
        return True
    span = instance.include.span
    parent = walk.instances[instance.parent].file
    return (
        span is not None and _once(work, parent, span) and _reachable(walk, work, instance.parent)
    )


def _root(walk: Walk, number: int) -> int:
    return _including(walk, number)[-1]


def _written(walk: Walk, work: _Work, folder: Path) -> Copies:
    """The texts, from the innermost files outwards: each has to know the copies it includes."""
    roots = [number for number, one in enumerate(walk.instances) if one.parent is None]
    changed = {number for number in work.edits if work.edits[number]} | {*work.rules, *work.starts}
    names: dict[int, str] = {}
    for number, instance in enumerate(walk.instances):
        if number in roots or any(number in _including(walk, one) for one in changed):
            names[number] = _free(instance.file.path.name, names.values())
    files: list[Copy] = []
    for number in reversed(names):  # those included come after
        if number in roots and number in changed:
            files += _root_copies(walk, work, number, names, folder)
        elif number in changed:
            files.append(_copy(walk.instances[number].file, names[number], work.edits[number]))
            parent, redirection = _redirection(walk, number, folder / names[number])
            work.edits[parent].append(redirection)
            changed.add(parent)
    launch = {walk.instances[root].file.path: names[root] for root in roots if root in changed}
    return Copies(tuple(reversed(files)), launch, tuple(work.notes))


def _including(walk: Walk, number: int) -> list[int]:
    """An instance, and those by way of which it is included."""
    parent = walk.instances[number].parent
    return [number, *([] if parent is None else _including(walk, parent))]


def _free(name: str, taken: Collection[str]) -> str:
    """A file name that no copy has yet."""
    candidates = (name if number == 1 else f"{number}_{name}" for number in count(1))
    return next(candidate for candidate in candidates if candidate not in taken)


def _redirection(walk: Walk, number: int, copy: Path) -> tuple[int, Edit]:
    """Let the including file include a copy: its number, and the edit."""
    instance = walk.instances[number]
    if instance.parent is None or instance.include is None or instance.include.span is None:
        raise ValueError(f"{instance.file.path} is not included in a place that can be edited")
    parent = walk.instances[instance.parent].file
    edit = LANGUAGES[parent.language].replaced(parent, instance.include.span, str(copy))
    return instance.parent, edit


def _root_copies(
    walk: Walk, work: _Work, number: int, names: Mapping[int, str], folder: Path
) -> list[Copy]:
    """The copy of a launch file itself, or the one that includes it."""
    instance, name = walk.instances[number], names[number]
    file, edits = instance.file, work.edits[number]
    language = LANGUAGES[file.language]
    start = None
    wrapped = file.language == "python" and work.rules[number] and not edits
    if language.keep_folder(file) is not None and not wrapped:
        start = language.add_at_start(file, work.rules[number], work.starts[number])
    if start is not None:
        return [_copy(file, name, [*edits, *start])]
    copies: list[Copy] = []
    included = file.path
    if edits:
        inner = _free(f"included_{name}", names.values())
        copies.append(_copy(file, inner, edits))
        included = folder / inner
    text = wrapper_text(included, work.rules[number], work.starts[number], instance.required)
    work.notes.append(
        f"{file.path}: better not edited, so {folder / name} is a new launch file that includes it"
        + (" and adds the remap, bound to the node's name" if work.rules[number] else "")
    )
    return [Copy(name, text, file.path, ""), *copies]


def _copy(file: LaunchFile, name: str, edits: Sequence[Edit]) -> Copy:
    """A copy that says where it came from wherever its original asked.

    Raises:
        OperationError: the text no longer is a launch file (which would be our mistake).
    """
    moved = LANGUAGES[file.language].keep_folder(file) or []
    inside = [
        edit
        for edit in moved
        if not any(one.span.start <= edit.span.start < one.span.end for one in edits)
    ]
    text = apply_edits(file.text, [*inside, *edits])
    try:
        read_text(file.path, text)
    except InputError as error:
        raise OperationError(
            f"{file.path} cannot be edited: its copy would be wrong: {error}"
        ) from error
    return Copy(name, text, file.path, file.text)


def unified_diff(copy: Copy, folder: Path) -> str:
    """What was changed, from the original to the copy."""
    lines = difflib.unified_diff(
        copy.before.splitlines(keepends=True),
        copy.text.splitlines(keepends=True),
        str(copy.original) if copy.before else "/dev/null",
        str(folder / copy.name),
    )
    return "".join(line if line.endswith("\n") else f"{line}\n" for line in lines)
