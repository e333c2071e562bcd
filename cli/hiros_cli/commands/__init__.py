"""The commands, one module each. Only typer is imported here; the work's imports wait."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import Any, cast

import typer

from hiros_cli.commands import (
    calibrate,
    check,
    compare,
    evaluate,
    export,
    info,
    plan,
    plot,
    process,
    recover,
    setup,
    simulate,
    view,
)
from hiros_cli.options import HelpfulCommand, flag
from hiros_mcap import __version__
from hiros_mcap.errors import ConfigError

# The root of click's errors: click's own, or that of the copy that newer typer carries.
CLICK_ERROR = cast("type[Exception]", typer.BadParameter.__mro__[2])

app = typer.Typer(
    name="hiros",
    help="Turn a log of several cameras' skeletons into one clean, smooth skeleton per person.",
    epilog="`hiros help COMMAND` shows a command's options.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"hiros {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def hiros(
    context: typer.Context,
    version: bool = flag(
        "--version", "Print the version.", "-V", callback=_show_version, is_eager=True
    ),
    verbose: bool = flag("--verbose", "With any command: show its steps on stderr."),
    debug: bool = flag("--debug", "With any command: show tracebacks of errors."),
) -> None:
    """Options of all commands; :mod:`hiros_cli.common_options` has read their values before."""
    if context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit(2)


app.command(cls=HelpfulCommand)(process.process)
app.command(cls=HelpfulCommand)(view.view)
app.command(cls=HelpfulCommand)(plot.plot)
app.command(cls=HelpfulCommand)(export.export)
app.command("eval", cls=HelpfulCommand)(evaluate.evaluate)
app.command(cls=HelpfulCommand)(check.check)
app.command(cls=HelpfulCommand)(compare.compare)
app.command(cls=HelpfulCommand)(info.info)
app.command("import", cls=HelpfulCommand)(export.import_)
app.command(cls=HelpfulCommand)(recover.recover)
app.command(cls=HelpfulCommand)(simulate.demo)
app.command(cls=HelpfulCommand)(simulate.simulate)
app.command(cls=HelpfulCommand)(plan.plan)
app.command(cls=HelpfulCommand)(setup.systems)
app.add_typer(calibrate.app, name="calibrate")
app.command(cls=HelpfulCommand)(setup.config)
app.command(cls=HelpfulCommand)(setup.warmup)


def dispatch(arguments: list[str]) -> int:
    """Run one command and return its exit code.

    Raises
    ------
    ConfigError
        The arguments do not make sense; one line that names the command's help.
    BrokenPipeError
        Nobody reads what is printed.
    """
    for before, argument in pairwise(["", *arguments]):
        # As a path it would be the current folder; it is a shell variable that is not set.
        if not argument and not before.startswith("-"):
            raise ConfigError("an argument is empty; is a variable not set?")
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    try:
        code = program().main(args=arguments, prog_name="hiros", standalone_mode=False)
    except CLICK_ERROR as error:
        context = getattr(error, "ctx", None)
        path = "hiros" if context is None else context.command_path
        reason = " ".join(cast(Any, error).format_message().split())
        raise ConfigError(f"{reason} (see {path} --help)") from error
    except SystemExit as error:
        if not error.code:  # a shell was told how to complete the line
            return 0
        # The only other exit that typer still makes by itself: its reader has closed the pipe.
        raise BrokenPipeError from error
    return code if isinstance(code, int) else 0


@cache
def program() -> Any:
    """Return the root of the commands, as ``hiros`` runs and shows them."""
    command: Any = typer.main.get_command(app)
    _show_plain_arguments(command)
    return command


def _show_plain_arguments(command: Any) -> None:
    """Show arguments by their names alone: newer typer adds Python types, LOG <list[Path]>."""
    for sub in getattr(command, "commands", {}).values():
        _show_plain_arguments(sub)
    for parameter in command.params:
        if parameter.param_type_name == "argument":
            shown = f"{parameter.metavar}..." if parameter.nargs != 1 else str(parameter.metavar)
            shown = shown if parameter.required else f"[{shown}]"
            parameter.get_usage_pieces = lambda ctx, shown=shown: [shown]
            parameter.display_type_rich = lambda ctx: ""
