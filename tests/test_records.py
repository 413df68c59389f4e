"""Records of benchmarks: fingerprints change with the results of a model, and outdated records are marked."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from cases import each

from ogm import Mount
from ogm.geometric import RayISM
from ogm.models import named
from ogm.models.combined import StateReliability

sys.path.insert(0, str(Path(__file__).parents[1] / "docs"))
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import _fingerprints as fingerprints
import record_tables

LESS_SURE = {"reliability": (StateReliability(1.0, 0.52), StateReliability(0.79, 1.0))}
OUTDATED = "since then the results of `ray` have changed."
UNKNOWN = "measured before records held checksums of models."


@pytest.fixture
def numbers() -> list[float]:
    return list(fingerprints.fingerprint("ray"))


@each("setting", ["p_miss", "obstacle_height", "no_return_weight"])
def test_a_setting_of_a_model_changes_its_fingerprint(setting: str, numbers: list[float]) -> None:
    ism = RayISM(fingerprints.SPEC, Mount(1.9))
    changed = replace(ism, **{setting: 1.2 * getattr(ism, setting)})
    assert fingerprints.same("ray", fingerprints.summed(ism(fingerprints.street()).mass))
    assert not fingerprints.same("ray", fingerprints.summed(changed(fingerprints.street()).mass))


def test_a_combination_of_other_numbers_has_another_fingerprint(monkeypatch: pytest.MonkeyPatch) -> None:
    before = fingerprints.fingerprint("combined")
    monkeypatch.setattr(named, "COMBINATION", named.COMBINATION | LESS_SURE)
    monkeypatch.setattr(fingerprints, "fingerprint", fingerprints.fingerprint.__wrapped__)
    assert not fingerprints.same("combined", before)


def test_an_outdated_record_is_marked_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, numbers: list[float]
) -> None:
    monkeypatch.setattr(record_tables, "RESULTS", tmp_path)
    other = [one + 0.01 for one in numbers]

    def why(*models: dict | None) -> str:
        """Return why a record of parts is outdated, each with the checksums of its models, or with none."""
        parts = [{"command": "python benchmarks/x.py"} | ({} if one is None else {"checksums": one}) for one in models]
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.json"
        path.write_text(json.dumps({"environment": parts[0], "parts": {str(k): one for k, one in enumerate(parts)}}))
        return record_tables.outdated(path.stem)

    same, changed = {"ray": {"fingerprint": numbers}}, {"ray": {"fingerprint": other}}
    assert why({}) == why(same) == why(same, {"own weights": {"fingerprint": other}}) == ""
    assert why(changed) == why(same, changed) == OUTDATED
    assert why(None) == why(same, None) == UNKNOWN
    monkeypatch.setattr(fingerprints, "same", lambda name, _: False)
    names = {name: {"fingerprint": numbers} for name in ("lite", "combined")}
    assert "`combined`, `lite`" in why(names)
    monkeypatch.setattr(record_tables, "TIMES", (f"{len(list(tmp_path.iterdir()))}",))
    assert why(names) == ""  # of times: other weights take as long
    monkeypatch.undo()
    monkeypatch.setattr(record_tables, "RESULTS", tmp_path)
    assert record_tables.marked("0", "table") == "table"
    assert record_tables.marked("3", "table") == f"table\n\n**Outdated:** {OUTDATED}"
