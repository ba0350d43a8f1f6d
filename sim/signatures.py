"""Kinds of files, and what tells that this package wrote one; each floor declares those that it writes."""

KINDS = {
    b"PK\x03\x04": "archive",
    b"\x89PNG": "picture",
    b"GIF8": "animation",
    b"\x89MCAP": "MCAP recording",
    b"<!": "web page",
    b"<html": "web page",
    b"# .PCD": "point cloud",
    b"\x08": "network",
}
"""Kinds of files by their first bytes; all else is data."""

SIGNATURES: dict[str, list[bytes]] = {}
"""Bytes of which a file of a kind holds one if this package wrote it: names of its columns, formats and notes."""

MANIFESTS: dict[str, bytes] = {}
"""Manifests of the folders that this package writes, each with bytes that it holds."""


def sign(kind: str, *marks: bytes) -> None:
    """Declare bytes of which a file of a kind, a value of `KINDS` or `data`, holds one if this package wrote it."""
    SIGNATURES.setdefault(kind, []).extend(marks)


def sign_folder(manifest: str, mark: bytes) -> None:
    """Declare the name of a folder's manifest, and bytes that it holds if this package wrote the folder."""
    MANIFESTS[manifest] = mark
