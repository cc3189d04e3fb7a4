"""What the user declares that no event shows: which topic's messages a node hands on to which.

`--through /f=/cmd` says that messages of `/f` are what publications of `/cmd` are made of, although
they go from one callback to the other through memory, a lock-free buffer or a library. Of several
messages the newest before the publication, or the loop's instance, counts.
"""

from collections.abc import Sequence

from chainshaper.values.errors import InputError


def parse_through(texts: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Return pairs of an input and an output: ``/f=/cmd`` → ``("/f", "/cmd")``.

    A slash that is missing in front of a name is added.

    Raises InputError: a text is no such pair.
    """
    pairs = dict[tuple[str, str], None]()
    for text in texts:
        names = [name.strip() for name in text.split("=")]
        if len(names) != 2 or not all(names) or any(name.split() != [name] for name in names):
            raise InputError(
                f"--through {text!r}: write the topic that is read and the one that is published,"
                " with = between them, such as /command=/motor"
            )
        read, written = (f"/{name.lstrip('/')}" for name in names)
        if read == written:
            raise InputError(
                f"--through {text!r}: a topic is not handed over to itself; name the output that"
                " its messages go into"
            )
        pairs[read, written] = None
    return tuple(pairs)
