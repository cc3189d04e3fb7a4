"""Where events come from: recordings of our own, and the traces that others write.

:func:`open_source` is the one door: whatever it opens is a
:class:`~chainshaper.recording.Recording`, so no verb and no analysis needs to know the difference.
"""

from pathlib import Path

from chainshaper.recording import Recording, open_recording

__all__ = ["open_source"]


def open_source(path: str | Path) -> Recording:
    """Open a recording folder.

    Raises:
        InputError: there is nothing that can be read.
    """
    return open_recording(path)
