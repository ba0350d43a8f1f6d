"""Files in the cache folder that keep a result for every process and later run.

A file is named by a hash of all that decides its content: settings, seed, the files of the roads, code and versions of
other packages. It is there completely or not at all; one that is damaged is made again.
"""

import hashlib
from pathlib import Path

import msgspec

from sim.files import file_sha256
from sim.kept.code_hash import code_hash, package_versions
from sim.roads.cache import cache_folder
from sim.roads.networks import names_network, resolve_network, resolve_polygons
from sim.scenario import Scenario


def kept_file(kind: str, ending: str, module: str, scenario: Scenario, seed: int, *more: object) -> Path:
    """Return the path of what a module computes for a scenario and a seed.

    Args:
        ending: suffix of the file name.
        module: its source and imports are hashed.
        more: decides it too, as values of JSON.
    """
    files = [resolve_network(scenario, seed), resolve_polygons(scenario)] if names_network(scenario) else []
    roads = [file_sha256(path) for path in files if path is not None]
    key = [msgspec.json.encode(scenario).decode(), seed, roads, code_hash(module), package_versions(module), *more]
    digest = hashlib.sha256(msgspec.json.encode(key, order="deterministic")).hexdigest()[:32]
    return cache_folder() / kind / f"{digest}{ending}"
