from io import BytesIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dsrc.data.formats.decimals import read_numbers

PAD = b" " * 64
"""So much of the end of a text is not left to the compiled loop."""

numbers = st.one_of(
    st.floats(allow_infinity=False, allow_nan=False).map(repr),
    st.floats(width=32, allow_infinity=False, allow_nan=False).map(lambda x: f"{x:.10g}"),
    st.builds("{:.{}{}}".format, st.floats(-1e6, 1e6), st.integers(0, 18), st.sampled_from("efgEG")),
    # Digits and powers of all kinds, also of 20 digits and with exponents beyond the loop's.
    st.builds(
        "{}{}.{}e{}".format,
        st.sampled_from(["", "-", "+"]),
        st.integers(0, 10**12),
        st.integers(0, 10**10),
        st.integers(-110, 110),
    ),
    st.integers(-(10**20), 10**20).map(str),
)


def same(words: list[bytes], separator: bytes = b" ") -> None:
    found = read_numbers(memoryview(separator.join(words) + PAD), len(words))
    expected = np.array([float(word) for word in words])
    assert found is not None
    assert found.view(np.int64).tolist() == expected.view(np.int64).tolist()


@given(st.lists(numbers, max_size=30), st.sampled_from([b" ", b"\n", b"\r\n", b" \t ", b"\v", b"\f"]))
def test_every_number_is_read_to_the_last_bit_as_pythons_float_does(words: list[str], separator: bytes) -> None:
    same([word.encode() for word in words], separator)


@given(st.lists(st.floats(width=32, allow_infinity=False, allow_nan=False), min_size=4, max_size=40))
def test_what_open3d_writes_of_a_float32_reads_as_numpys_parser_reads_it(values: list[float]) -> None:
    text = b"\n".join(b"%.10g %.10g" % (a, b) for a, b in zip(values[::2], values[1::2], strict=False)) + b"\n"
    expected = np.loadtxt(BytesIO(text), ndmin=2).ravel()
    found = read_numbers(memoryview(text + PAD), len(expected))
    assert found is not None and found.tobytes() == expected.tobytes()
    assert np.array_equal(found.astype(np.float32), np.array(values[: len(found)], np.float32))


@given(st.floats(1e-45, 1e60), st.sampled_from([-1, 0, 1]))
def test_numbers_halfway_between_two_floats_and_next_to_that_are_rounded_right(value: float, beside: int) -> None:
    """Their 19 first digits are all that the loop takes; a middle has more, and one digit more or less decides."""
    above = float(np.nextafter(value, np.inf))
    numerator, denominator = value.as_integer_ratio()
    more, other = above.as_integer_ratio()
    middle = (numerator * other + more * denominator, 2 * denominator * other)
    power = 18 - len(str(middle[0] // middle[1])) if middle[0] >= middle[1] else 18 + len(str(middle[1] // middle[0]))
    digits = (middle[0] * 10**power // middle[1] if power >= 0 else middle[0] // (middle[1] * 10**-power)) + beside
    same([b"%de%d" % (digits, -power)])


def test_hard_numbers_are_read_to_the_last_bit() -> None:
    same(
        b"9007199254740993 9007199254740992.5 -0 -0.0 +1.5 .5 5. 1e5 1E+05 0e-300 1e22 1e23 1e-22 1e-23 1e80 1e-80 "
        b"5e-324 2.2250738585072011e-308 1.7976931348623157e308 1e400 -1e-400 18446744073709551615 0.1 1.1754944e-38 "
        b"00000000000000000001.5 0.000000000000000000012345 9999999999999999999 123456789012345678901234567890 inf "
        b"-Infinity 1e00000005 8.5 1_000 1.401298464e-45 89255.0e-22 3.4028235677973366e38 1e81 "
        b"1.00000017881393432617187499".split()
    )


def test_lost_beams_are_nan() -> None:
    found = read_numbers(memoryview(b"nan 1.5 NaN -nan\nnan" + PAD), 5)
    assert found is not None
    assert np.isnan(found).tolist() == [True, False, True, True, True] and found[1] == 1.5


@pytest.mark.parametrize(
    ("text", "count"),
    [
        (b"1 2 x", 3), (b"1.2.3", 1), (b"1e", 1), (b"--1", 1), (b"-", 1), (b".", 1), (b"1,5", 1), (b"0x10", 1),
        (b"nano", 1), (b"e5", 1), (b"1 2 3", 2), (b"1 2 3", 4), (b"", 1), (b"1", 10**15),
    ],
)  # fmt: skip
def test_words_that_are_no_numbers_and_other_counts_are_nothing(text: bytes, count: int) -> None:
    assert read_numbers(memoryview(text + PAD), count) is None
    assert read_numbers(memoryview(PAD + text), count) is None


def test_a_text_need_not_end_with_white_space() -> None:
    text = b"\n".join(b"%d.25" % i for i in range(100))
    assert np.array_equal(read_numbers(memoryview(text), 100), np.arange(100) + 0.25)
