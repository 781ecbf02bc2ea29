"""The command line in this process: what a process of its own takes seconds for before it begins."""

from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from subprocess import CompletedProcess

from pagas_cl.__main__ import run


def command(*arguments: object) -> CompletedProcess:
    """Status and what was written, as in a pipe."""
    words = [str(word) for word in arguments]
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
        status = run(words)
    return CompletedProcess(words, status, out.getvalue(), err.getvalue())
