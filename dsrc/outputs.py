"""Files and folders that `dsrc` writes, and the marks by which each is known as ours; see `sim.files`."""

from sim.files import MARKS

COMMENT = b"Software: dsrc"
"""Comment of an animation by which it is known as ours."""

_MARKS = {
    "archive": (b"episode.npy", b"dsrc-detector-1", b"dsrc-detectors-1"),
    "picture": (b"Description\0{",),
    "animation": (COMMENT,),
    "MCAP recording": (b"dsrc-testbed",),
    "web page": (b"__REVIEW__", b'content="dsrc drive"'),
    "network": (b"dsrc-testbed",),
    "data": (
        b'# {"',
        b"scenario,perception,",
        b'classname="dsrc.',
        b"SHA-256 of the drives: `",
        b'"dsrc error model',
        b"Driven by `dsrc drive`",
        b'author="dsrc-testbed"',
        b'vendor="dsrc-testbed"',
    ),
    "data_protocol.yaml": (b"testbed:",),
    "conversion.json": (b'"drives"',),
    "corruption.json": (b'"corruption"',),
    "manifest.json": (b'"drives"',),
    "card.json": (b'"agent_frames"',),
    "settings.json": (b'"recipe"',),
    "results.json": (b'"provenance"',),
    "scores.json": (b'"provenance"',),
    "shares.json": (b'"provenance"',),
    "realism.json": (b'"provenance"',),
    "plan.json": (b'"perceptions"',),
}
for _kind, _marks in _MARKS.items():
    MARKS[_kind] = (*MARKS.get(_kind, ()), *_marks)
