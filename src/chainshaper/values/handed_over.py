"""What the user declares that no event shows: which topic's messages a node hands on to which.

`--through /f=/cmd` says that messages of `/f` are what publications of `/cmd` are made of, although
they go from one callback to the other through memory, a lock-free buffer or a library. Of several
messages the newest before the publication, or the loop's instance, counts.
"""

from collections.abc import Iterable, Sequence
from typing import Annotated, TypeAlias

from pydantic import AfterValidator

from chainshaper.values.errors import InputError

Through: TypeAlias = tuple[tuple[str, str], ...]
"""Pairs of topics: the messages of the first one go into those of the second."""


def parse_through(texts: Sequence[str], given_as: str = "--through") -> Through:
    """Return pairs of an input and an output: ``/f=/cmd`` → ``("/f", "/cmd")``.

    A slash that is missing in front of a name is added. ``given_as`` is what the user wrote the
    texts behind.

    Raises InputError: a text is no such pair.
    """
    pairs = dict[tuple[str, str], None]()
    for text in texts:
        names = [name.strip() for name in text.split("=")]
        if len(names) != 2 or not all(names) or any(name.split() != [name] for name in names):
            raise InputError(
                f"{given_as} {text!r}: write the topic that is read and the one that is published,"
                " with = between them, such as /command=/motor"
            )
        read, written = (f"/{name.lstrip('/')}" for name in names)
        if read == written:
            raise InputError(
                f"{given_as} {text!r}: a topic is not handed over to itself; name the output that"
                " its messages go into"
            )
        pairs[read, written] = None
    return tuple(pairs)


def through_texts(pairs: Iterable[tuple[str, str]]) -> tuple[str, ...]:
    """Return pairs as the user writes them: ``("/f", "/cmd")`` → ``/f=/cmd``."""
    return tuple(f"{read}={written}" for read, written in pairs)


def _handed_over(value: str) -> str:
    try:
        (text,) = through_texts(parse_through([value], "through:"))
    except InputError as error:
        raise ValueError(str(error)) from None
    return text


HandedOver = Annotated[str, AfterValidator(_handed_over)]
"""A field of a file that declares it, as :func:`through_texts` writes it."""
