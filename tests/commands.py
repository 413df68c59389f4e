"""The command line, run in this process."""

from click.testing import Result
from typer.testing import CliRunner

from ogm.cli import app


def ogm(*words: object) -> Result:
    """Run a command on a terminal of 200 columns; errors that it does not turn into an exit code are raised."""
    result = CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def completed(*words: object) -> Result:
    """Run a command that must succeed."""
    result = ogm(*words)
    assert result.exit_code == 0, result.output
    return result


def refused_command(message: str, *words: object) -> Result:
    """Run a command that must end with exit code 2 and one line of error that holds a message."""
    result = ogm(*words)
    assert result.exit_code == 2, result.output
    assert message in result.output
    assert sum(line.startswith("ogm: ") for line in result.output.splitlines()) == 1, result.output
    return result
