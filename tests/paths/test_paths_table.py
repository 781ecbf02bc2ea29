"""Every command, option, effect and kind of mesh file has a place in the table."""

from dataclasses import fields
from itertools import combinations

import pytest
import typer
from paths.table import COMMANDS, MATRIX, ON_A_TERMINAL, columns, options_of

from pagas_cl.__main__ import build_app, command_names
from pagas_cl.config import Effects
from pagas_cl.scene.meshes.files import SUFFIXES

APP = typer.main.get_command(build_app(command_names()))
EFFECTS = [field.name for field in fields(Effects)]
OF_MATRIX = {"--mesh", "--depth-dir", "--output", "--set", "--effect", "--fuse", "--keep-mesh"}


def rows_of(command: str) -> list[list[str]]:
    return [row.arguments.split() for row in COMMANDS.values() if row.arguments.split()[0] == command]


@pytest.mark.parametrize("command", command_names())
def test_every_command_and_option_has_a_row(command):
    assert rows_of(command), f"no row of tests/paths/table.py has the command {command!r}"
    run = {word for arguments in rows_of(command) for word in arguments} | set(ON_A_TERMINAL)
    if command == "refine":
        run |= OF_MATRIX | {line for line in columns()[0] if line.startswith("--")}
    assert sorted(options_of(command) - run) == [], f"options of {command} that tests/paths/table.py has no row with"


def test_options_of_all_commands_have_a_row():
    run = {word for row in COMMANDS.values() for word in row.arguments.split()}
    assert {word for option in APP.params for word in option.opts} - run <= {"--help"}


def test_the_table_has_nothing_that_is_not_there():
    for row in COMMANDS.values():
        command, *arguments = row.arguments.split()
        known = options_of(command) | {"--help", "--debug", "--verbose", "--version"}
        assert {word for word in arguments if word.startswith("--")} <= known, row.arguments
    lines = {line.split()[0] for line in MATRIX.strip().splitlines()}
    assert {line for line in lines if line.startswith("--")} <= options_of("refine")
    assert {line for line in lines if not line.startswith("--")} == {"path", "off", "kind", "run", "call", *EFFECTS}


@pytest.mark.parametrize("effect", EFFECTS)
def test_every_effect_meets_every_path(effect):
    assert effect in columns()[0], f"MATRIX of tests/paths/table.py has no line for the effect {effect!r}"
    for line, choices in (("path", ("mesh", "keep", "fuse", "new", "maps")), ("off", "013"),
                          ("--quiet", ("yes", "no"))):
        met = {(column[line], column[effect]) for column in columns()}
        assert met == {(word, choice) for word in choices for choice in ("auto", "on", "off")}, (line, effect)


def test_every_kind_of_mesh_file_is_written():
    assert {column["kind"] for column in columns() if column["path"] != "maps"} == set(SUFFIXES)


def test_any_two_lines_meet():
    """What the table was made for; a new effect need not."""
    lines = {name: {column[name] for column in columns()} for name in columns()[0] if name != "kind"}
    apart = [(one, two) for one, two in combinations(lines, 2) if len({(c[one], c[two]) for c in columns()}) <
             len(lines[one]) * len(lines[two])]
    assert set(apart) <= {("path", "--save-depth")} | {
        pair for pair in apart if "--no-align" in pair}, apart
