"""Files and folders that `dsrc` writes, and how each is known as ours; see `sim.files`."""

from sim.files import sign, sign_folder

COMMENT = b"Software: dsrc"
"""Comment of an animation by which it is known as ours."""

sign("archive", b"episode.npy", b"dsrc-detector-1", b"dsrc-detectors-1")
sign("picture", b"Description\0{")
sign("animation", COMMENT)
sign("MCAP recording", b"dsrc-testbed")
sign("web page", b"__REVIEW__")
sign("network", b"dsrc-testbed")
sign(
    "data",
    b'# {"',
    b"scenario,perception,",
    b"SHA-256 of the drives: `",
    b'"dsrc error model',
    b"Driven by `dsrc drive`",
)

sign_folder("data_protocol.yaml", b"testbed:")
sign_folder("conversion.json", b'"drives"')
sign_folder("corruption.json", b'"corruption"')
sign_folder("manifest.json", b'"drives"')
sign_folder("card.json", b'"agent_frames"')
sign_folder("settings.json", b'"recipe"')
sign_folder("results.json", b'"provenance"')
sign_folder("scores.json", b'"provenance"')
sign_folder("shares.json", b'"provenance"')
sign_folder("plan.json", b'"perceptions"')
