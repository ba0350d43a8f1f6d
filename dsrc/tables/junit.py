"""JUnit's XML of checks, which CI systems show as tests.

Source: the schema of Jenkins' xUnit plugin (junit-10.xsd) and of Maven Surefire, of which every CI system reads the
common part: suites with `name`, `tests`, `failures`, `errors` and `skipped`, cases with `classname`, `name` and `time`.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal
from xml.etree import ElementTree

_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 has no way to write (section 2.2)."""


@dataclass(frozen=True, slots=True)
class Case:
    """Check of a suite.

    Attributes:
        group: dotted name of the checks that it belongs to.
        name: its own.
        result: how it ended: a failure is of what was checked, an error of the check itself.
        message: why it did not pass, one line.
        output: further text; "" for none.
        time_s: how long it took, s; None where nobody measured.
    """

    group: str
    name: str
    result: Literal["passed", "failure", "error", "skipped"] = "passed"
    message: str = ""
    output: str = ""
    time_s: float | None = None


@dataclass(frozen=True, slots=True)
class Suite:
    """Checks under one name."""

    name: str
    cases: tuple[Case, ...]


def junit_xml(name: str, suites: Sequence[Suite]) -> bytes:
    """Return JUnit's XML: a `testsuites` of several suites, the `testsuite` itself of one."""
    if len(suites) == 1:
        root = _suite(suites[0])
    else:
        every = [case for one in suites for case in one.cases]
        root = ElementTree.Element("testsuites", {"name": _text(name)} | _counts(every))
        root.extend(_suite(one) for one in suites)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _suite(one: Suite) -> ElementTree.Element:
    skipped = str(sum(case.result == "skipped" for case in one.cases))
    found = ElementTree.Element("testsuite", {"name": _text(one.name), "skipped": skipped} | _counts(one.cases))
    for case in one.cases:
        named = {"classname": _text(case.group), "name": _text(case.name)}
        named |= {} if case.time_s is None else {"time": f"{case.time_s:.3f}"}
        place = ElementTree.SubElement(found, "testcase", named)
        if case.result != "passed":
            ElementTree.SubElement(place, case.result, message=_text(case.message))
        if case.output:
            ElementTree.SubElement(place, "system-out").text = _text(case.output)
    return found


def _counts(cases: Sequence[Case]) -> dict[str, str]:
    found = [case.result for case in cases]
    counts = {"tests": len(found), "failures": found.count("failure"), "errors": found.count("error")}
    return {name: str(count) for name, count in counts.items()}


def _text(text: str) -> str:
    return _FORBIDDEN.sub("?", text)
