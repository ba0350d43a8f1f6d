"""Perceptions by name, by file and of one's own."""

import importlib
import sys
from dataclasses import replace as copied
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from msgspec.structs import replace

from dsrc.closed_loop.loop import ClosedLoop
from dsrc.closed_loop.perception.detector import DetectorPerception
from dsrc.closed_loop.perception.open import open_perception, parse_perception
from dsrc.closed_loop.perception.truth import SightPerception, TruthPerception
from dsrc.detectors.classes import source_hash
from dsrc.detectors.texts import SHIPPED_DETECTOR
from dsrc.models.fusion.late import join_detections
from sim.boxes import CLASSES, VEHICLES
from sim.errors import CheckpointError, SettingsError
from sim.radio import get_channel

OWN = """
from dsrc.ops.detections import Detections

class Blind:
    def detect(self, sample):
        return Detections.zeros()

class Everyone(Blind):
    from sim.boxes import CLASSES as classes

class Own:
    cooperative = False
    def reset(self, scenario, ego_id, seed): ...
    def perceive(self, before, now, claims): ...

class Misspelt(Blind):
    classes = ("car", "lorry")

class Nothing: ...

class Broken:
    def __init__(self):
        raise RuntimeError("no\\nlicence")
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A module of one's own in the current folder, which is not on the path of imports."""
    (tmp_path / "my_eyes.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", ["/nowhere", *[p for p in __import__("sys").path if p not in ("", str(tmp_path))]])
    monkeypatch.delitem(__import__("sys").modules, "my_eyes", raising=False)


def test_the_engine_of_a_detector_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dsrc.models.storage.deploy.BFLOAT16", False)
    assert open_perception("team").engine == "fused"  # type: ignore[attr-defined]
    assert open_perception("team", engine="plain").engine == "plain"  # type: ignore[attr-defined]
    with pytest.raises(SettingsError, match="engine: bf16: expected a processor with bfloat16"):
        open_perception("team", engine="bf16")


def test_truth_and_sight() -> None:
    assert type(open_perception("truth")) is TruthPerception
    for name, cooperative in (("sight", False), ("team-sight", True)):
        sight = open_perception(name)
        assert type(sight) is SightPerception and sight.cooperative == cooperative


@pytest.mark.parametrize(
    ("text", "cooperative"),
    [
        ("ego", False),
        ("team", True),
        ("dsrc", True),
        (str(SHIPPED_DETECTOR), True),
        (f"mine={SHIPPED_DETECTOR}", True),
        (f"ego={SHIPPED_DETECTOR}", False),
        ("late", True),
        (f"late={SHIPPED_DETECTOR}", True),
    ],
)
def test_detectors_by_name_and_file(text: str, cooperative: bool) -> None:
    perception = open_perception(text, corruption="fog", severity=4, corrupted_agents="helpers", channel="paper")
    assert isinstance(perception, DetectorPerception)
    assert perception.cooperative is cooperative
    assert perception.senses.condition.severity == 4
    assert perception.channel.name == ("paper" if cooperative else "ideal")
    assert perception.detector.settings.fusion == ("late" if text.startswith("late") else "attention")
    assert perception.classes == VEHICLES


def test_late_fusion_joins_what_each_agent_detects_alone() -> None:
    late, team = open_perception("late"), open_perception("team")
    loop = ClosedLoop("lta_truck", open_perception("truth"))
    loop.run(1)
    late.reset(loop.scenario, loop.ego_id, 1)
    sample, _ = late.sample(loop.ticks[40].actors, loop.ticks[41].actors, {})
    parts = [
        team.detector.detect(
            copied(
                sample,
                agent_ids=sample.agent_ids[k : k + 1],
                clouds=sample.clouds[k : k + 1],
                ego_from_agent=sample.ego_from_agent[k : k + 1],
                agent_boxes=sample.agent_boxes[k : k + 1],
            )
        )
        for k in range(len(sample.agent_ids))
    ]
    joined = late.detector.detect(sample)
    assert len(parts) > 2 and len(joined) > len(parts[0])
    expected = join_detections(parts, late.detector.settings.nms_iou)
    assert np.allclose(joined.boxes.array, expected.boxes.array, atol=1e-3)
    assert np.allclose(joined.score, expected.score, atol=1e-4)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("truth", ("truth", "truth", "")),
        ("a/b/fine.pt", ("fine", "team", "a/b/fine.pt")),
        ("mine=a/late.pt", ("mine", "team", "a/late.pt")),
        ("late=a.pt", ("late", "late", "a.pt")),
        ("ego=a", ("ego", "ego", "a")),
        ("alone=ego", ("alone", "ego", "")),
        ("dsrc", ("dsrc", "team", "")),
        ("mine=dsrc", ("mine", "team", "")),
        ("errors=team.json", ("errors", "model", "team.json")),
        ("my_eyes:Own", ("my_eyes:Own", "my_eyes:Own", "")),
        ("mine=my_eyes:Own", ("mine", "my_eyes:Own", "")),
        ("runs/a=1/b.pt", ("b", "team", "runs/a=1/b.pt")),
    ],
)
def test_names_kinds_and_files(text: str, words: tuple[str, str, str]) -> None:
    assert parse_perception(text) == words


def test_classes_of_ones_own(own: None) -> None:
    assert type(open_perception("my_eyes:Own")).__name__ == "Own"
    perception = open_perception("my_eyes:Blind", corruption="snow", channel="paper")
    assert isinstance(perception, DetectorPerception) and perception.cooperative
    assert perception.detector.settings.grid.range_m[3] == 51.2
    assert perception.classes == VEHICLES and perception.detector.name == "Blind"
    assert open_perception("my_eyes:Everyone").classes == CLASSES


def test_a_class_of_a_notebook_opens_and_a_new_one_of_its_name_is_another(monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = ModuleType("a_notebook")  # without a spec and without a file, as `__main__` there
    monkeypatch.setitem(sys.modules, "a_notebook", notebook)
    hashes = set()
    for _ in range(2):
        exec(OWN, notebook.__dict__)
        for _ in range(2):
            assert type(open_perception("a_notebook:Own")).__name__ == "Own"
            hashes.add(source_hash("a_notebook:Own"))
        notebook.Former = notebook.Own
    assert len(hashes) == 2


def test_a_class_that_was_changed_since_its_import_needs_a_new_process(own: None) -> None:
    open_perception("my_eyes:Own")
    file = Path("my_eyes.py")
    before = file.read_text()
    file.write_text(before + "OTHER = 1\n")
    with pytest.raises(SettingsError, match="my_eyes:Own: expected the module as it was imported, or a new process"):
        open_perception("my_eyes:Own")
    importlib.reload(sys.modules["my_eyes"])
    open_perception("my_eyes:Own")
    file.write_text(before)
    with pytest.raises(SettingsError, match="my_eyes:Own: expected the module as it was imported"):
        open_perception("my_eyes:Own")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("my_eyes:Nothing", "expected a class with reset and perceive, or with detect, found a Nothing without them"),
        ("my_eyes:Broken", "expected a class that loads, found RuntimeError: no licence"),
        ("my_eyes:Misspelt", r"Misspelt\.classes: expected a tuple of car, .*, found \('car', 'lorry'\)"),
        ("my_eyes:Blnd", "expected a class that loads, found AttributeError"),
        ("your_eyes:Own", "expected a class that loads, found ModuleNotFoundError: No module named 'your_eyes'"),
        ("trut", "name: expected a name, .*, found trut; did you mean 'truth'"),
    ],
)
def test_what_does_not_load_is_an_error_of_one_line(own: None, text: str, message: str) -> None:
    with pytest.raises(SettingsError, match=message) as raised:
        open_perception(text)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "settings", "field"),
    [
        ("truth", {"corruption": "fog"}, "corruption"),
        ("sight", {"channel": "paper"}, "channel"),
        ("team-sight", {"channel": "paper"}, "channel"),
        ("truth", {"checkpoint": SHIPPED_DETECTOR}, "checkpoint"),
        ("my_eyes:Own", {"corruption": "fog"}, "corruption"),
        ("my_eyes:Own", {"checkpoint": SHIPPED_DETECTOR}, "checkpoint"),
        (f"ego={SHIPPED_DETECTOR}", {"checkpoint": SHIPPED_DETECTOR}, "checkpoint"),
    ],
)
def test_settings_of_what_a_perception_has_not_are_refused(own: None, text: str, settings: dict, field: str) -> None:
    with pytest.raises(SettingsError, match=f"^perception: .*leave out --{field}$"):
        open_perception(text, **settings)


def test_a_wrong_setting_or_file_is_refused(tmp_path: Path) -> None:
    for settings in ({"corruption": "fogg"}, {"channel": "pigeon"}, {"engine": "steam"}, {"corrupted_agents": "me"}):
        with pytest.raises(SettingsError):
            open_perception("team", **settings)
    with pytest.raises(SettingsError, match="corrupted_agents: expected helpers"):
        open_perception("team", corruption="pose_error", corrupted_agents="ego")
    with pytest.raises(CheckpointError, match="no such checkpoint file"):
        open_perception(str(tmp_path / "gone.pt"))


def test_settings_of_a_channel_serve_as_well_as_its_name() -> None:
    spec = replace(get_channel("its-g5-6"), packet_loss=0.5)
    assert open_perception("team", channel=spec).channel == spec
    with pytest.raises(SettingsError, match="channel"):
        open_perception("truth", channel=spec)
