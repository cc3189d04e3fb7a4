"""All verbs of the command line."""

from importlib import import_module
from typing import Any

import typer
from typer import Abort

__all__ = ["USAGE_ERROR", "Abort", "app"]

USAGE_ERROR: Any = typer.BadParameter.__base__
"""What Typer raises where a command line is wrong; the name of its module changes."""

app = typer.Typer(
    help="Constant end-to-end latency for ROS 2 computation chains, without touching their code.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)

VERBS = (
    *("demo", "run", "simulate", "sweep"),
    *("record", "profile", "info", "graph", "callbacks", "chains", "latency", "convert"),
    *("plan", "offsets", "splice", "shape", "compare", "report", "export"),
    *("threads", "apply", "status", "release", "doctor"),
)
"""As `--help` lists them; each is a function in the module of its name."""

for verb in VERBS:
    app.command()(getattr(import_module(f"chainshaper.cli.{verb}"), verb))
