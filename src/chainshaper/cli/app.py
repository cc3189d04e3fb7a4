"""All verbs of the command line."""

from collections.abc import Callable

import typer

from chainshaper.cli.apply import apply
from chainshaper.cli.callbacks import callbacks
from chainshaper.cli.chains import chains
from chainshaper.cli.compare import compare
from chainshaper.cli.convert import convert
from chainshaper.cli.demo import demo
from chainshaper.cli.doctor import doctor
from chainshaper.cli.export import export
from chainshaper.cli.graph import graph
from chainshaper.cli.info import info
from chainshaper.cli.latency import latency
from chainshaper.cli.offsets import offsets
from chainshaper.cli.plan import plan
from chainshaper.cli.profile import profile
from chainshaper.cli.record import record
from chainshaper.cli.release import release
from chainshaper.cli.report import report
from chainshaper.cli.run import run
from chainshaper.cli.shape import shape
from chainshaper.cli.simulate import simulate
from chainshaper.cli.splice import splice
from chainshaper.cli.status import status
from chainshaper.cli.sweep import sweep
from chainshaper.cli.threads import threads

__all__ = ["app"]

app = typer.Typer(
    help="Constant end-to-end latency for ROS 2 computation chains, without touching their code.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)

VERBS: tuple[Callable[..., None], ...] = (
    demo,
    run,
    simulate,
    sweep,
    record,
    profile,
    info,
    graph,
    callbacks,
    chains,
    latency,
    convert,
    plan,
    offsets,
    splice,
    shape,
    compare,
    report,
    export,
    threads,
    apply,
    status,
    release,
    doctor,
)
for verb in VERBS:
    app.command()(verb)
