"""Dispatch of the command line: finds the command, reads its options, runs it."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from importlib import import_module
from typing import Literal

import msgspec
from tyro.conf import Positional

COMMANDS: Mapping[str, str | Mapping[str, str]] = {
    "list": "scenario.ListNames",
    "scenario": {
        "list": "scenario.List",
        "show": "scenario.Show",
        "check": "scenario.Check",
        "import": "scenario.Import",
        "mine": "scenario.Mine",
        "export": "scenario.Export",
    },
    "generate": "dataset.Generate",
    "corrupt": "dataset.Corrupt",
    "dataset": {
        "build": "dataset.Build",
        "record": "dataset.Record",
        "render": "dataset.Render",
        "check": "dataset.Check",
        "card": "dataset.Card",
        "convert": "dataset.Convert",
    },
    "model": {
        "train": "model.Train",
        "verify": "model.Verify",
        "import": "model.Import",
        "join": "model.Join",
        "export": "model.Export",
        "fit": "model.Fit",
    },
    "detect": "evaluate.Detect",
    "evaluate": "evaluate.Evaluate",
    "benchmark": "evaluate.Benchmark",
    "stress": "evaluate.StressTest",
    "shares": "evaluate.Shares",
    "score": "evaluate.Score",
    "realism": "dataset.Realism",
    "view": "view.View",
    "drive": "drive.Drive",
    "search": "drive.Search",
    "demo": "demo.Demo",
    "completion": "main.Completion",
}
"""Commands, or groups of commands, by name: module of this package and class of the options."""

DESCRIPTION = "CPU-first testbed for cooperative driving: simulate, sense, corrupt, detect, drive, review."


class Completion(msgspec.Struct, frozen=True):
    """Print the script with which a shell completes commands, options and names.

    Examples:
        dsrc completion bash > ~/.local/share/bash-completion/completions/dsrc
        eval "$(dsrc completion zsh)"

    Attributes:
        shell: shell that runs the script.
    """

    shell: Positional[Literal["bash", "zsh"]]

    def run(self) -> None:
        """Print the script."""
        from dsrc.cli.completion import script

        sys.stdout.write(script(self.shell, dict(commands())))


def run(args: Sequence[str] | None = None) -> None:
    """Parse `args` (default: the process's) and run the command.

    Raises:
        SystemExit: after help, or when the options are wrong.
        UserError: the command cannot do what is asked for.
    """
    words = list(sys.argv[1:] if args is None else args)
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]
    prog = "dsrc"
    level: Mapping[str, str | Mapping[str, str]] = COMMANDS
    while True:
        word = words.pop(0) if words else "--help"
        if word in ("-h", "--help"):
            sys.stdout.write(_overview(prog, level))
            raise SystemExit(0)
        if word == "--version" and level is COMMANDS:
            from importlib.metadata import version

            sys.stdout.write(f"dsrc {version('dsrc-testbed')}\n")
            return
        if word not in level:
            raise SystemExit(_unknown(prog, level, word))
        prog, found = f"{prog} {word}", level[word]
        if isinstance(found, str):
            from dsrc.cli.options import parse
            from dsrc.options.fields import Output
            from sim.files import overwriting

            command = parse(command_class(found), prog, words)
            # Only commands that write have the option.
            with overwriting(getattr(command, "output", Output()).force):
                command.run()
            return
        level = found


def commands() -> Iterator[tuple[tuple[str, ...], type]]:
    """Yield the words of every command and the class of its options."""
    for name, found in COMMANDS.items():
        if isinstance(found, str):
            yield (name,), command_class(found)
        else:
            for part, place in found.items():
                yield (name, part), command_class(place)


def command_class(place: str) -> type:
    """Return the class of a command's options, from a value of `COMMANDS`."""
    module, _, name = place.partition(".")
    found = getattr(import_module(f"dsrc.cli.{module}"), name)
    assert isinstance(found, type)
    return found


def _overview(prog: str, level: Mapping[str, str | Mapping[str, str]]) -> str:
    """Return the help of a group: its commands, one line each."""
    from dsrc.cli.options import summary

    lines = [f"usage: {prog} COMMAND [OPTIONS]", ""]
    if prog == "dsrc":
        lines += [DESCRIPTION, ""]
    for name, found in level.items():
        if isinstance(found, str):
            lines.append(f"  {name:18s} {summary(command_class(found))}")
        else:
            lines += [f"  {f'{name} {part}':18s} {summary(command_class(place))}" for part, place in found.items()]
    lines += ["", f"`{prog} COMMAND --help` lists the options of a command."]
    if prog == "dsrc":
        lines[-1] += " `dsrc --version` prints the version."
    return "\n".join(lines) + "\n"


def _unknown(prog: str, level: Mapping[str, object], word: str) -> int:
    """Write a line about a command that does not exist; returns the exit code."""
    near = get_close_matches(word, level, 1)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    sys.stderr.write(f"{prog}: command: expected one of {', '.join(level)}, found {word}{hint}\n")
    return 2
