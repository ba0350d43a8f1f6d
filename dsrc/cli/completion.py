"""Script of `dsrc completion`: words that a shell offers, made of the structs that the help is made of."""

import re
from collections.abc import Iterable, Iterator, Mapping

from dsrc.cli.options import fields_of, metavar, option_words

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


def script(shell: str, commands: Mapping[tuple[str, ...], type]) -> str:
    """Return the script of a shell, bash or zsh.

    Args:
        commands: class of the options of every command, by its words.
    """
    begin = "autoload -Uz compinit bashcompinit && compinit && bashcompinit\n" if shell == "zsh" else ""
    return begin + _SCRIPT % "\n".join(_cases(commands))


def _cases(commands: Mapping[tuple[str, ...], type]) -> Iterator[str]:
    """Yield a branch of the script for every group and command, and for every option with choices: its words."""
    groups: dict[str, list[str]] = {}
    for *group, name in commands:
        groups.setdefault(" ".join(group), []).append(name)
    yield _case("", [*dict.fromkeys(first for first, *_ in commands), "help"])
    yield from (_case(group, names) for group, names in groups.items() if group)
    for words, command in commands.items():
        yield from _command_cases(" ".join(words), command)


def _command_cases(words: str, command: type) -> Iterator[str]:
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
