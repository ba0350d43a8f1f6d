"""OpenStreetMap binary files (.osm.pbf), converted by osmium to OSM XML for netconvert and polyconvert."""

from pathlib import Path

from sim.errors import ScenarioError
from sim.reading import parsing, read_bytes

MOST_BYTES = 1 << 30
"""Most bytes of a map when unpacked."""
_CHECKED_EVERY = 10_000


def pbf_to_xml(source: Path, target: Path) -> None:
    """Write the nodes, ways and relations of a .osm.pbf file as OSM XML.

    Raises:
        ScenarioError: the file is missing, truncated, of another format or larger than `MOST_BYTES` as XML.
    """
    import osmium  # only these files need it

    data = read_bytes(source, ".osm.pbf file", ScenarioError)
    with parsing(source, ".osm.pbf file", ScenarioError):
        count = 0
        with osmium.SimpleWriter(osmium.io.File(target, "osm,add_metadata=false"), overwrite=True) as writer:
            for count, element in enumerate(osmium.FileProcessor(osmium.io.FileBuffer(data, "pbf")), 1):
                writer.add(element)
                if count % _CHECKED_EVERY == 0 and target.stat().st_size > MOST_BYTES:
                    raise ValueError(f"more than {MOST_BYTES} bytes when unpacked")
        if not count:
            raise ValueError("it holds no nodes")
