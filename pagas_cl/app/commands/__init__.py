"""The commands of `pagas-cl`: one file a command, whose function `command` typer turns into options.

A file that starts with an underscore holds what several commands share.
"""
