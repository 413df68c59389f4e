"""The page of the command line: usage, options and defaults of every command, from the commands themselves."""

import re
from collections.abc import Iterator
from typing import Any

import typer


def command_page() -> str:
    """Return the page in reStructuredText."""
    from typer.main import get_command

    from ogm.cli import app

    top = get_command(app)
    parts = ["Command line\n============\n", f"{plain(top.help)}\n"]
    commands = {f"ogm {name}": command for name, command in commands_of(top)}
    parts += [
        f"* :ref:`{name} <{label(name)}>`: {plain(one.get_short_help_str(200))}" for name, one in commands.items()
    ]
    parts += ["", section(typer.Context(top, info_name="ogm"), "Options before a command")]
    for name, command in commands.items():
        parts += [f".. _{label(name)}:\n", section(typer.Context(command, info_name=name), name)]
    return "\n".join(parts)


def commands_of(group: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each command with its words, such as "world build"."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands_of(command, f"{before}{name} ")
        else:
            yield f"{before}{name}", command


def section(context: Any, title: str) -> str:
    """Return usage, description and options of a command."""
    command = context.command
    usage = " ".join(command.collect_usage_pieces(context))
    parts = [f"{title}\n{'-' * len(title)}\n", f".. program:: {context.info_name}\n"]
    parts.append(f".. code-block:: text\n\n   {context.info_name} {usage}\n")
    if context.info_name != "ogm":
        parts += [plain(text) + "\n" for text in re.split(r"\n\s*\n", command.help or "")]
    for parameter in command.get_params(context):
        if record := parameter.get_help_record(context):
            names, text = record
            parts.append(f".. option:: {names.replace(' / ', ', ')}\n\n   {plain(text)}\n")
    if command.epilog:
        parts.append(f".. code-block:: console\n\n   $ {command.epilog.partition(':')[2].strip()}\n")
    return "\n".join(parts)


def label(command: str) -> str:
    """Return the anchor of a command."""
    return command.replace(" ", "-")


def plain(text: str | None) -> str:
    """Return a help text as a paragraph, without markup but that of code."""
    parts = re.split(r"(`[^`]+`)", " ".join((text or "").replace("\b", "").split()))
    return "".join(f"`{part}`" if part[:1] == "`" else re.sub(r"([\\*`|_])", r"\\\1", part) for part in parts)
