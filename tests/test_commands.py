"""Commands of installed packages: by entry points; the command line names what is not there."""

import errno
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import NoReturn

import click
import pytest
from click.testing import CliRunner

from wfsobs.cli import group


@click.command()
def hello() -> None:
    """Greet."""
    click.echo("hello")


@pytest.fixture
def points(monkeypatch: pytest.MonkeyPatch) -> list[EntryPoint]:
    points: list[EntryPoint] = []
    monkeypatch.setattr(group, "entry_points", lambda group: [point for point in points if point.group == group])
    return points


def test_a_package_brings_a_command(points: list[EntryPoint], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(EntryPoint, "load", lambda _self: hello)
    points.append(EntryPoint("hello", "somewhere.cli:hello", group.ENTRY_POINTS))
    assert CliRunner().invoke(group.main, ["hello"]).output == "hello\n"
    assert "Of the package somewhere." in CliRunner().invoke(group.main, ["--help"]).output


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), (1, "")),
        (BrokenPipeError(errno.EPIPE, "Broken pipe", "pipe"), (2, "wfsobs: pipe: Broken pipe\n")),
        (OSError(errno.EACCES, "Permission denied", Path("night.npz")), (2, "wfsobs: night.npz: Permission denied\n")),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), (2, "wfsobs: Cannot allocate memory\n")),
        (OSError("no more"), (2, "wfsobs: no more\n")),
    ],
    ids=["output that nobody reads", "pipe", "file", "no file", "no number"],
)
def test_an_error_of_the_system_is_one_line_unless_nobody_reads_the_output(
    points: list[EntryPoint], monkeypatch: pytest.MonkeyPatch, error: OSError, outcome: tuple[int, str]
) -> None:
    def fail(*_: object) -> NoReturn:
        raise error

    @click.command()
    def write() -> None:
        fail()

    monkeypatch.setattr(EntryPoint, "load", lambda _self: write)
    points.append(EntryPoint("write", "somewhere.cli:write", group.ENTRY_POINTS))
    monkeypatch.setattr(group.Commands, "get_help", fail)
    for argument in ("write", "--help"):
        done = CliRunner().invoke(group.main, [argument])
        assert (done.exit_code, done.output) == outcome


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("hello", "Error: hello: no.such:hello cannot be imported: ModuleNotFoundError: No module named 'no'"),
        ("arena", "Error: arena is a package of its own: pip install wfsobs-arena"),
        ("nothing", "Error: No such command 'nothing'."),
    ],
)
def test_what_is_not_there_is_named(points: list[EntryPoint], name: str, line: str) -> None:
    points.append(EntryPoint("hello", "no.such:hello", group.ENTRY_POINTS))
    result = CliRunner().invoke(group.main, [name])
    assert result.exit_code == 2 and result.output.splitlines()[-1] == line


def test_no_option_takes_what_is_no_finite_number() -> None:
    def options(command: click.Command, ctx: click.Context) -> Iterator[click.Option]:
        if isinstance(command, click.Group):
            for name in command.list_commands(ctx):
                if (one := command.get_command(ctx, name)) is not None:
                    yield from options(one, ctx)
        yield from (it for it in command.params if isinstance(it, click.Option))

    ctx = click.Context(group.main)
    found = [it for it in options(group.main, ctx) if isinstance(it.type, (click.FloatRange, click.types.FloatParamType))]
    assert len(found) > 30
    for option in found:
        for text in ("nan", "inf"):
            with pytest.raises(click.BadParameter):
                option.type.convert(text, option, ctx)
