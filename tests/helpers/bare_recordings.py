"""Recordings of endpoints alone, for what asks nothing else of them."""

import json
from pathlib import Path

from chainshaper.values.recording import Recording, open_recording


def recorded(
    folder: Path, *endpoints: tuple[str, str, str], type_: str | None = None, **about: str
) -> Recording:
    """A recording that saw nothing but who has which topic: nodes, topics, kinds."""
    place = folder / "recording"
    place.mkdir()
    keys = ("node", "topic", "kind")
    seen = [{**dict(zip(keys, endpoint, strict=True)), "type": type_} for endpoint in endpoints]
    info = {"source": "lttng", "clock_offset_ns": 0, "endpoints": seen, **about}
    (place / "recording.json").write_text(json.dumps(info))
    return open_recording(place)
