"""How notebooks show our values: a class that has :func:`notebook_html` as `_repr_html_`.

What is shown is made in a room above this one, and only when a notebook asks for it.
"""


def notebook_html(value: object) -> str:
    """Show a value in a notebook as :func:`chainshaper.html_of` does."""
    import chainshaper

    return chainshaper.html_of(value)
