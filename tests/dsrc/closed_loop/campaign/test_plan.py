"""A campaign has one engine for all its detectors."""

from pathlib import Path

import pytest

from dsrc.closed_loop.campaign.read import campaign_of
from dsrc.options.driving import DriveOptions
from sim.files import file_sha256


def test_a_campaign_has_one_engine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    poor = tmp_path / "poor.pt"
    poor.write_bytes(b"weights")
    monkeypatch.setattr("dsrc.models.storage.deploy.BFLOAT16", True)
    monkeypatch.setattr("dsrc.models.storage.deploy.FLOAT32_ONLY", frozenset({file_sha256(poor)}))
    for names, engine in ((("team",), "bf16"), (("team", f"poor={poor}"), "fused"), (("truth",), "fused")):
        assert campaign_of(DriveOptions(what="ima_building", perception=names)).engine == engine
