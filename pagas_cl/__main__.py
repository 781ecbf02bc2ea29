"""The command line: finds the command, runs it, and turns what went wrong into an exit status and one sentence.

Exit status: 0 done; 2 bad input, bad usage, or an optional package or an OpenCL device that is missing; 3 done, but
nothing was refined; 1 anything else; 130 interrupted; 143 ended by SIGTERM.
"""

import pkgutil
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from inspect import signature
from typing import Any, get_origin

import typer
from typer.models import OptionInfo

from pagas_cl.app import commands
from pagas_cl.app.commands._process import log_to_stderr, make_streams_safe, replace_cache, typed
from pagas_cl.config.version import __version__
from pagas_cl.errors import InputError, InterruptedRunError, PagasError, plain

INTERRUPTED = InterruptedRunError.exit_status


def command_names() -> list[str]:
    """Every command, from the files in pagas_cl/app/commands."""
    found = (module.name for module in pkgutil.iter_modules(commands.__path__))
    return sorted(name.replace("_", "-") for name in found if not name.startswith("_"))


def options_of_lists(command: Callable[..., Any]) -> list[str]:
    """The options of a command that take several words: `--views a b c`."""
    parameters = signature(command).parameters.values()
    return [name for parameter in parameters if get_origin(parameter.annotation) is list
            and isinstance(parameter.default, OptionInfo) for name in parameter.default.param_decls]


def expand_lists(arguments: list[str], many) -> list[str]:
    """`--views a b` as `--views a --views b`, for options in `many`; InputError for one that nothing follows
    (`--hold-out $NAMES`, not set): it would count as not given."""
    result: list[str] = []
    option = None
    for word, following in zip(arguments, [*arguments[1:], "-"]):
        if word in many and following.startswith("-"):
            raise InputError(f"{word} has no value, expected one or several: give them, or leave it out")
        if word.startswith("-"):
            option = word if word in many else None
            result += [] if option else [word]
        else:
            result += [option, word] if option else [word]
    return result


def check_places(arguments: list[str]) -> None:
    """InputError where a place to write to is an empty word ("$OUT", not set), which would be the present folder, or
    begins with a ~ that the shell has left as it is: who deletes a folder of that name loses their own."""
    for word, following in zip(arguments, [*arguments[1:], "."]):      # the last one may need no value
        option, given, place = word.partition("=")
        if option not in ("--output", "--save-depth", "--report", "--json", "--save-script"):
            continue
        place = place if given else following
        if not place:
            raise InputError(f"{option} is empty, expected the name of a file or folder ('.' is the present one)")
        if place.startswith("~/"):
            raise InputError(f"{option} is {place!r}, a folder called ~, since the shell leaves that as it is after = "
                             f"and in quotes: write {option} {place}, or the whole path")


def build_app(names) -> typer.Typer:
    """The typer application with the commands `names`, whose files are imported here and not before."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, callback=_options,
                      help="Refine a coarse mesh or depth maps with calibrated photos, on any OpenCL device.")
    for name in names:
        app.command(name)(_module(name).command)
    return app


def _module(name: str):
    return import_module(f"pagas_cl.app.commands.{name.replace('-', '_')}")


def main() -> None:
    """Run the command line and end the process with its status. SIGTERM ends the work as Ctrl-C does."""
    ended_by = []

    def end(number, frame) -> None:
        ended_by.append(number)
        signal.default_int_handler(number, frame)

    signal.signal(signal.SIGTERM, end)
    make_streams_safe()
    status = run(sys.argv[1:])
    if status == INTERRUPTED and ended_by:
        status = 128 + signal.SIGTERM
    sys.stdout.flush()
    fault = getattr(sys.stdout, "fault", "")
    if fault:
        sys.stderr.write(f"pagas-cl: standard output cannot be written: {fault}\n")
    raise SystemExit(status or int(bool(fault)))


def run(arguments: list[str]) -> int:
    """Run the command line; returns the exit status. What went wrong is the last line, below all warnings."""
    debug = "--debug" in arguments
    try:
        with log_to_stderr(details=debug or "--verbose" in arguments):
            return _run([word for word in arguments if word not in ("--debug", "--verbose")] or ["--help"])
    except (KeyboardInterrupt, typer.Abort):
        sys.stderr.write("pagas-cl: interrupted\n")
        return INTERRUPTED
    except Exception as error:  # the outermost place: whatever it is becomes a sentence, the last one, and a status
        if debug:
            raise
        return _explain(error)


def _run(arguments: list[str]) -> int:
    known = command_names()
    wanted = [word for word in arguments if not word.startswith("-")][:1]
    one = wanted if wanted and wanted[0] in known else []
    check_places(arguments)
    many: list[str] = []
    if one:
        replace_cache()
        many = options_of_lists(_module(one[0]).command)
    status = build_app(one or known)(expand_lists(arguments, many), prog_name="pagas-cl", standalone_mode=False,
                                     obj=typed(["pagas-cl", *arguments]))  # for reports
    if status == INTERRUPTED:  # typer has caught it
        raise KeyboardInterrupt
    return status if isinstance(status, int) else 0


def _explain(error: Exception) -> int:
    """Write one sentence about `error` to standard error; returns the exit status."""
    status = 1
    if hasattr(error, "format_message"):  # typer's own errors: unknown option, missing argument
        status = 2
        text = f"{error.format_message().rstrip('.')}; see 'pagas-cl --help'"
    elif isinstance(error, PagasError):
        status = error.exit_status
        text = getattr(error, "at_command_line", "") or str(error)
    elif isinstance(error, OSError) and error.errno is not None:
        what = (repr(str(error.filename)) if error.filename      # what has no name is where relative ones begin
                else "the present folder" if isinstance(error, FileNotFoundError) else "a file")
        text = (f"{what} cannot be written or read: {error.strerror or error}; see to its disk and permissions (with "
                "--debug: where)")
    elif type(error).__module__.startswith("pyopencl"):
        text = (f"the OpenCL device failed ({error}): start the same command again; where it fails again, update its "
                "driver or choose another device (pagas-cl devices)")
    else:
        text = f"{type(error).__name__}: {error} (run again with --debug to see where)"
    sys.stderr.write(f"pagas-cl: {plain(' '.join(text.split()))}\n")
    return status


def _show_version(wanted: bool):
    if wanted:
        sys.stdout.write(f"pagas-cl {__version__}\n")
        raise typer.Exit()


def _options(
    verbose: bool = typer.Option(False, "--verbose", help="Show what was measured and planned, too."),
    debug: bool = typer.Option(False, "--debug", help="The same, and a traceback when something goes wrong."),
    version: bool = typer.Option(False, "--version", callback=_show_version, is_eager=True, help="Show the version."),
):
    """Options before the command; `--verbose` and `--debug` may stand anywhere and are read in `run`."""


if __name__ == "__main__":
    main()
