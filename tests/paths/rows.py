"""One row of the table's COMMANDS: run in a terminal and in a pipe, and compared."""

from pathlib import Path

from paths.matrix import data_in
from paths.places import Places
from paths.run import run
from paths.table import COMMANDS, ON_A_TERMINAL, options_of


def named(*commands: str) -> list[str]:
    """Names of the rows of these commands; of all others where none is given."""
    return [name for name, row in COMMANDS.items() if row.arguments.split()[0] in commands]


def check_row(name: str, places: Places, folder: Path) -> None:
    """Run a row wherever it is to be run: it ends as it should, and the same bytes come out."""
    row, found = COMMANDS[name], []
    for place in row.places.split(", "):
        arguments = places.arguments(row.arguments, folder / place)
        if place == "terminal":
            arguments += [option for option in ON_A_TERMINAL if option in options_of(arguments[0])]
        (folder / place).mkdir()
        ran = run(arguments, place, row.until)
        ran.must_end_well(row.status, fault="--debug" in arguments)
        assert row.says in ran.text, f"{row.says!r} is not in:\n{ran.text[-3000:]}"
        _check_written(arguments, folder / place, row.status)
        found.append(data_in(folder / place))
    assert all(files == found[0] for files in found), [sorted(files) for files in found]


def _check_written(arguments, folder: Path, status: int) -> None:
    """Whatever the arguments name below `folder` was written; nothing at all where they were refused."""
    written = {Path(word).relative_to(folder).parts[0] for word in arguments if word.startswith(f"{folder}/")}
    there = {path.name for path in folder.iterdir()}
    if status == 2:
        assert not there, sorted(there)
    elif "--debug" not in arguments:
        assert there >= written, sorted(written - there)
