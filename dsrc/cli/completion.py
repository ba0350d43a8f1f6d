"""Command `dsrc completion`: words that a shell offers, made of the structs that the help is made of."""

import re
import sys
from collections.abc import Iterable, Iterator
from typing import Literal

import msgspec
from tyro.conf import Positional

_CHOICES = re.compile(r"\{([^}]*)\}")

_SCRIPT = """\
_dsrc_words() {
  case "$1" in
%s
    *) return 1 ;;
  esac
}
_dsrc() {
  local current="${COMP_WORDS[COMP_CWORD]}" command="" option="" words="" word
  for word in "${COMP_WORDS[@]:1:COMP_CWORD-1}"; do
    if [[ $word == -* ]]; then
      option=" $word"
    elif [[ -z $option ]] && _dsrc_words "$command${command:+ }$word" > /dev/null; then
      command="$command${command:+ }$word"
    fi
  done
  if [[ $current == -* ]] || ! words=$(_dsrc_words "$command$option"); then
    words=$(_dsrc_words "$command")
    [[ -n $option && $current != -* ]] && words=""
  fi
  COMPREPLY=($(compgen -W "$words" -- "$current"))
}
complete -o default -F _dsrc dsrc
"""
"""Without an answer the shell offers files."""


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
        if self.shell == "zsh":
            sys.stdout.write("autoload -Uz compinit bashcompinit && compinit && bashcompinit\n")
        sys.stdout.write(_SCRIPT % "\n".join(_cases()))


def _cases() -> Iterator[str]:
    """Yield a branch of the script for every command, and for every option with choices: its words."""
    from dsrc.cli.main import COMMANDS, command_class

    yield _case("", [*COMMANDS, "help"])
    for name, found in COMMANDS.items():
        if isinstance(found, str):
            yield from _command_cases(name, command_class(found))
        else:
            yield _case(name, found)
            for part, place in found.items():
                yield from _command_cases(f"{name} {part}", command_class(place))


def _command_cases(words: str, command: type[msgspec.Struct]) -> Iterator[str]:
    from dsrc.cli.options import fields_of, metavar, option_words

    offered, cases = ["--help"], []
    for name, kind, *_ in fields_of(command):
        listed = _choices(metavar(kind))
        spelled = option_words(name, kind)
        offered += spelled or listed
        if spelled and listed:
            cases.append(_case(f"{words} {spelled[0]}", listed))
    yield from (_case(words, offered), *cases)


def _choices(metavar: str) -> list[str]:
    """Return the words that a metavar lists, without those that stand for other words."""
    if metavar == "SCENARIO":
        from sim.catalog.load import list_scenarios

        return list_scenarios()
    listed = _CHOICES.match(metavar)
    return [word for word in listed[1].split(",") if word == word.lower()] if listed else []


def _case(key: str, words: Iterable[str]) -> str:
    return f'    "{key}") echo "{" ".join(words)}" ;;'
