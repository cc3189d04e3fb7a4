"""Values as HTML, each with its picture: what a notebook shows of them.

The tables are those of the report, and the pictures those of `--figures` and of the report.
"""

import base64
from collections.abc import Callable, Sequence
from typing import Any

from chainshaper.analysis import LatencyAnalysis, graph_of, recorded_flow
from chainshaper.planning import ChainPlan, Plan
from chainshaper.reporting import figures
from chainshaper.reporting import latency as of_chain
from chainshaper.reporting.graph_drawing import timed_graph_svg
from chainshaper.reporting.overviews import plan_table
from chainshaper.reporting.tables import ResultTable
from chainshaper.values.errors import InputError, escape, installing
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import Comparison, Measurement


def html_of(value: object) -> str:
    """Return a recording, latency, plan or comparison as HTML, with its picture.

    Raises InputError: another kind of value.
    """
    match value:
        case Recording():
            flow = recorded_flow(value)
            drawing = timed_graph_svg(flow, graph_of(flow))
            return f'{_line(repr(value))}<div style="overflow-x: auto">{drawing}</div>'
        case LatencyAnalysis():
            picture = _picture(figures.hops_figure, [value], [value.chain.spec])
            return _line(repr(value)) + picture + _table(of_chain.breakdown_table(value))
        case Measurement():
            name = value.recording.path.name
            picture = _picture(figures.hops_figure, [value.analysis], [name])
            return _line(repr(value)) + picture + _table(of_chain.latency_table(value))
        case Comparison():
            picture = _picture(figures.latency_figure, value.measurements)
            return _line(repr(value)) + picture + _table(of_chain.comparison_table(value))
        case ChainPlan():
            return _plans([value])
        case Plan():
            return _plans(value.chains)
    kinds = "a recording, a latency, a plan or a comparison"
    raise InputError(f"{type(value).__name__} cannot be shown as HTML: give {kinds}")


def _plans(plans: Sequence[ChainPlan]) -> str:
    return "".join(
        _line(repr(plan)) + _picture(figures.plan_figure, plan) + _table(plan_table(plan))
        for plan in plans
    )


def _picture(make: Callable[..., Any], *values: Any) -> str:
    """Paint a figure into the page, or say what is needed for it."""
    try:
        picture = base64.b64encode(figures.png_of_figure(make, *values)).decode("ascii")
    except ModuleNotFoundError as error:
        remedy = installing("'chainshaper[analysis]'")
        return _line(f"The picture needs {error.name}, which is not installed: {remedy}")
    return f'<p><img src="data:image/png;base64,{picture}" style="max-width: 100%"></p>'


def _table(table: ResultTable) -> str:
    return _line(table.title) + table.html() + _line(table.caption or "")


def _line(text: str) -> str:
    return f"<p>{escape(text)}</p>" if text else ""
