"""The list of records: complete, and a record that is current is kept."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "docs"))
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import record_tables
import remake

ROOT = Path(__file__).parents[1]
RECORDS, DATA = remake.read_table()


def test_every_record_has_a_command_and_every_command_a_record() -> None:
    assert RECORDS.keys() == {path.stem for path in (ROOT / "benchmarks/results").glob("*.json")}


def test_commands_name_programs_and_data_sets_that_exist() -> None:
    used = set()
    for minutes, recordings, script, *words in RECORDS.values():
        assert float(minutes) > 0
        assert recordings in ("real", "-")
        assert (ROOT / script).is_file()
        used |= {word.partition("=")[0] for word in words} & DATA.keys()
    assert used == DATA.keys()


def test_data_sets_are_made_once_and_their_paths_are_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("GEN3", "OLD"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "contact-sheet.png").touch()
    (tmp_path / "GEN2").mkdir()
    calls: list[list[str]] = []
    monkeypatch.setattr(remake, "python", lambda *words: calls.append([*map(str, words)]) or len(calls) < 4)
    assert remake.remake("combined_fit", tmp_path)
    assert calls[0] == ["-m", "ogm.cli", "simulate", str(tmp_path / "GEN2"), *DATA["GEN2"], "--resume"]
    drives = (f"{tmp_path}/GEN2=0,1,4,5,8,9", f"{tmp_path}/GEN3=0,2,4,6,8,10", f"{tmp_path}/OLD=0,2,5")
    assert calls[1][1:] == [*drives, "--occupied", "0.8"]
    del calls[1:]
    assert remake.remake("realism", tmp_path)
    assert [call[0] for call in calls[1:]] == ["benchmarks/realism.py", "docs/realism_tables.py"]
    assert not remake.remake("fusion_quality", tmp_path)
    assert calls[3][2] == "simulate"
    assert len(calls) == 4  # nothing is measured without its data


def test_a_record_is_current_by_commit_by_date_and_by_its_models(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-C", str(tmp_path)]
    subprocess.run([*git, "init", "-q"], check=True)
    names = []
    for day in ("2026-01-01", "2026-01-02", "2026-01-03"):
        dates = {"GIT_AUTHOR_DATE": f"{day}T12:00Z", "GIT_COMMITTER_DATE": f"{day}T12:00Z"}
        subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", day], check=True, env=dates)
        names.append(subprocess.check_output([*git, "rev-parse", "HEAD"], text=True).strip())
    monkeypatch.setattr(remake, "ROOT", tmp_path)
    monkeypatch.setattr(remake, "RESULTS", tmp_path)
    monkeypatch.setattr(record_tables, "outdated", lambda name: "")

    def current(**part: str) -> bool:
        (tmp_path / "x.json").write_text(json.dumps({"parts": {"a": {"command": "x"} | part}}))
        return remake.is_current("x", names[1])

    assert not remake.is_current("none", names[1])
    assert [current(date="", commit=name) for name in names] == [False, True, True]
    assert not current(date="2026-01-05 00:00 UTC", commit=f"{names[2]}-dirty")
    assert current(date="2026-01-02 12:01 UTC")
    assert not current(date="2026-01-02 11:59 UTC")
    assert current(date="2026-01-02")
    monkeypatch.setattr(record_tables, "outdated", lambda name: "other results")
    assert not current(date="", commit=names[2])
