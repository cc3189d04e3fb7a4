"""All verbs of the command line, and their help as plain text.

A verb's module is imported when the verb is called: `chainshaper --help` has to be there at once.
Help is written without Rich, which takes longer to import than most verbs take to run.
"""

import sys
from importlib import import_module
from importlib.metadata import version
from typing import Any

import typer
from typer import Abort
from typer.core import TyperArgument, TyperCommand, TyperGroup
from typer.main import get_command

__all__ = ["GROUPS", "USAGE_ERROR", "VERBS", "Abort", "app"]

USAGE_ERROR: Any = typer.BadParameter.__base__
"""What Typer raises where a command line is wrong; the name of its module changes."""

GROUPS = {
    "Start": "demo init doctor",
    "Record": "record profile run simulate generate describe convert",
    "Look": "info graph chains callbacks latency report export threads watch",
    "Plan": "plan offsets sweep",
    "Shape": "shape splice apply status release",
    "Judge": "compare control budget check",
}
"""The verbs in the order in which `--help` lists them, by what a user wants to do."""

_MODULES = {
    "runs": "demo init run simulate generate record profile watch shape",
    "plans": "plan offsets sweep splice",
    "traces": "info describe graph callbacks chains latency convert compare budget check report"
    " export",
    "controls": "control",
    "applying": "threads apply status release doctor",
}
VERBS = {verb: module for module, verbs in _MODULES.items() for verb in verbs.split()}
"""The module of each verb, which is a function there."""

_SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 100}


def _as_shown(text: str) -> str:
    """Return what standard output can show of a text: Typer writes UTF-8 in any locale."""
    encoding = sys.stdout.encoding or "utf-8"
    return text.encode(encoding, sys.stdout.errors or "replace").decode(encoding)


class _PlainGroup(TyperGroup):
    """All verbs, whose help every terminal can show."""

    def get_help(self, ctx: Any) -> str:
        return _as_shown(super().get_help(ctx))

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002 - Click calls it so
        for title, verbs in GROUPS.items():
            commands = [(verb, self.commands[verb]) for verb in verbs.split()]
            with formatter.section(title):
                formatter.write_dl(
                    [(verb, command.get_short_help_str()) for verb, command in commands]
                )


class _PlainCommand(TyperCommand):
    """A command whose help has a section for each panel."""

    def get_help(self, ctx: Any) -> str:
        return _as_shown(super().get_help(ctx))

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        return [
            piece.strip("{}").replace("}...", "...") for piece in super().collect_usage_pieces(ctx)
        ]

    def panels(self, ctx: Any) -> dict[str, list[Any]]:
        """Return all parameters that help has, by the panel that they stand in."""
        panels: dict[str, list[Any]] = {}
        for parameter in self.get_params(ctx):
            usual = "Arguments" if isinstance(parameter, TyperArgument) else "Options"
            if parameter.get_help_record(ctx) is not None:
                panel = getattr(parameter, "rich_help_panel", None) or usual
                panels.setdefault(panel, []).append(parameter)
        return panels

    def format_options(self, ctx: Any, formatter: Any) -> None:
        for title, parameters in self.panels(ctx).items():
            with formatter.section(title):
                formatter.write_dl([parameter.get_help_record(ctx) for parameter in parameters])


class _Verb(TyperCommand):
    """A verb that is not imported yet."""

    def _function(self) -> Any:
        return getattr(import_module(f"chainshaper.cli.{VERBS[self.name or '']}"), self.name or "")

    def get_short_help_str(self, limit: int = 45) -> str:  # noqa: ARG002 - it is not cut off
        return " ".join(str(self._function().__doc__).partition("\n\n")[0].split())

    def imported(self) -> Any:
        """Return the verb with its options, from its module."""
        alone = typer.Typer(add_completion=False, rich_markup_mode=None, context_settings=_SETTINGS)
        alone.command(self.name, cls=_PlainCommand)(self._function())
        return get_command(alone)

    def make_context(self, *values: Any, **more: Any) -> Any:
        return self.imported().make_context(*values, **more)


_root = typer.Typer(rich_markup_mode=None, context_settings=_SETTINGS)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"chainshaper {version('chainshaper')}")
        raise typer.Exit


@_root.callback()
def _options(
    version: bool = typer.Option(
        False, "--version", help="Show the version and exit.", callback=_show_version, is_eager=True
    ),
) -> None:
    """Options without a verb: Typer adds those that install shell completion."""


app = _PlainGroup(
    name="chainshaper",
    help="Constant end-to-end latency for ROS 2 computation chains, without touching their code.",
    commands={verb: _Verb(verb) for verb in VERBS},
    no_args_is_help=True,
    params=[*get_command(_root).params],
    rich_markup_mode=None,
    context_settings=_SETTINGS,
)
