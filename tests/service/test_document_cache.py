"""Cache of documents of ended runs: two requests, one computation, and never older than their logs."""

from __future__ import annotations

from tdhil.service.document_cache import MOST, DocumentCache


def test_a_comparison_is_kept_until_a_log_changes(tmp_path):
    log = tmp_path / "one" / "run.mcap"
    log.parent.mkdir()
    log.write_bytes(b"1")
    kept, asked = DocumentCache(tmp_path), {"runs": ["one"], "runs_folder": str(tmp_path)}
    kept.put(kept.key("compare", asked), {"n": 1})
    assert kept.get(kept.key("compare", asked)) == {"n": 1}
    assert kept.get(kept.key("compare", asked | {"runs": ["one", "one"]})) is None
    log.write_bytes(b"12")
    assert kept.get(kept.key("compare", asked)) is None


def test_a_calibration_is_kept_until_one_of_its_logs_changes(tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.mcap").write_bytes(b"1")
    kept, asked = DocumentCache(tmp_path), {"without": "one", "with_body": "two", "added_kg_m2": 55.0}
    kept.put(kept.key("calibrate", asked), {"n": 1})
    assert kept.get(kept.key("calibrate", asked)) == {"n": 1}
    assert kept.get(kept.key("calibrate", asked | {"added_kg_m2": 50.0})) is None
    (tmp_path / "two" / "run.mcap").write_bytes(b"12")
    assert kept.get(kept.key("calibrate", asked)) is None


def test_a_trend_depends_on_its_rows_and_anything_else_is_computed_again(tmp_path):
    kept = DocumentCache(tmp_path)
    kept.put(kept.key("trend", {"rows": [1], "rig": "a"}), {"n": 1})
    assert kept.get(kept.key("trend", {"rows": [1], "rig": "a"})) == {"n": 1}
    assert kept.get(kept.key("trend", {"rows": [1, 2], "rig": "a"})) is None
    assert kept.key("replay", {"folder": "x"}) is None
    assert kept.key("plan", {"rig_file": "gone.yaml"}) is None
    assert kept.key("compare", {"runs": ["gone"]}) is None


def test_a_plan_is_kept_until_the_rig_s_file_changes(tmp_path):
    rig = tmp_path / "rig.yaml"
    rig.write_text("name: a")
    kept, asked = DocumentCache(tmp_path), {"rig_file": str(rig), "options": {}, "profile": "1"}
    kept.put(kept.key("plan", asked), {"n": 1})
    assert kept.get(kept.key("plan", asked)) == {"n": 1}
    assert kept.get(kept.key("plan", asked | {"profile": "2"})) is None
    assert kept.get(kept.key("plan", asked | {"options": {"tolerance": 0.01}})) is None
    rig.write_text("name: b")
    assert kept.get(kept.key("plan", asked)) is None


def test_the_number_of_kept_documents_is_limited(tmp_path):
    kept = DocumentCache(tmp_path)
    for rig in range(MOST + 1):
        kept.put(kept.key("trend", {"rows": [], "rig": str(rig)}), {"n": rig})
    assert kept.get(kept.key("trend", {"rows": [], "rig": "0"})) is None
    assert kept.get(kept.key("trend", {"rows": [], "rig": str(MOST)})) == {"n": MOST}
