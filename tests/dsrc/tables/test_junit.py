"""JUnit's XML: read back by a library, and by the schema's rules."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

from dsrc.tables.junit import Case, Suite, junit_xml

SUITES = [
    Suite("first", (Case("a.b", "fine"), Case("a.b", "bad", "failure", "found 3 < 4 & more", time_s=1.25))),
    Suite("second", (Case("c", "broke", "error", "it \x1b[31mraised\x00"), Case("c", "left", "skipped", "no reason"))),
]


def test_counts_and_required_attributes_are_those_of_the_schema() -> None:
    root = ElementTree.fromstring(junit_xml("all", SUITES))
    assert (root.tag, root.get("tests"), root.get("failures"), root.get("errors")) == ("testsuites", "4", "1", "1")
    assert [suite.tag for suite in root] == ["testsuite", "testsuite"]
    for suite in root:
        # junit-10.xsd: use="required"
        assert all(suite.get(name) is not None for name in ("name", "tests", "failures", "errors"))
        assert {case.tag for case in suite} == {"testcase"} and all(case.get("name") for case in suite)
    assert ElementTree.fromstring(junit_xml("one", SUITES[:1])).tag == "testsuite"


def test_a_library_reads_what_was_written(tmp_path: Path) -> None:
    junitparser = pytest.importorskip("junitparser")
    path = tmp_path / "junit.xml"
    path.write_bytes(junit_xml("all", SUITES))
    first, second = junitparser.JUnitXml.fromfile(str(path))
    assert (first.name, first.tests, first.failures, first.errors, first.skipped) == ("first", 2, 1, 0, 0)
    assert (second.name, second.tests, second.failures, second.errors, second.skipped) == ("second", 2, 0, 1, 1)
    fine, bad = first
    assert fine.is_passed and not bad.is_passed and bad.time == 1.25
    assert isinstance(bad.result[0], junitparser.Failure) and bad.result[0].message == "found 3 < 4 & more"
    broke, left = second
    assert isinstance(broke.result[0], junitparser.Error) and broke.result[0].message == "it ?[31mraised?"
    assert left.is_skipped
