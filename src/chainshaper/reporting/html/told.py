"""One recording, with all that the report tells of it."""

from dataclasses import dataclass

from chainshaper.analysis import DataFlow
from chainshaper.reporting.timeline import Timeline
from chainshaper.verify.measure import Measurement

__all__ = ["Told"]


@dataclass(frozen=True)
class Told:
    """A measurement under the ``name`` that tells it from the others of the report."""

    name: str
    measurement: Measurement
    flow: DataFlow
    timeline: Timeline
