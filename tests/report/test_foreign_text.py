"""Names from drives, profiles, logs and files: they are shown as text, without effect on terminal or markup."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rich.table import Table

from drivers.drive import Check, Identity, Outcome, Preflight
from drivers.errors import PreflightRefused
from profiles.visible_text import visible
from tdhil.cli.main import main
from tdhil.report.console import PlainConsole
from tdhil.report.live import preflight_table
from tdhil.runner.settings import ExcitationRequest
from tdhil.session.confirm import motion_summary

EVIL = "\x1b[2J\x1b]0;x\x07A\x9b31m[/][red]\u202egnirts\u2066\x00\r\nDrive: safe\u2028 \x7f"
ROOT = Path(__file__).parents[2]


def harmless(text: str) -> bool:
    return all(sign == "\n" or sign.isprintable() for sign in text)


def shown(*parts: object) -> str:
    file = io.StringIO()
    PlainConsole(file).print(*parts)
    return file.getvalue()


@given(st.text())
@example(EVIL)
def test_visible_is_one_printable_line_of_the_same_length(text):
    found = visible(text)
    assert found.isprintable()
    assert len(found) == len(text)
    assert visible(found) == found
    assert all(one == two for one, two in zip(text, found, strict=True) if one.isprintable())


@given(st.text(max_size=40))
@example(EVIL)
@example("[/]")
@example("[link=file:///etc]x[/link]")
def test_a_console_obeys_nothing(text):
    table = Table("check", "found", title=text)
    table.add_row(text, text)
    assert harmless(shown(text))
    assert harmless(shown(table))


def test_markup_is_text():
    assert "[bold]drive[/bold] [/]" in shown("[bold]drive[/bold] [/]")


def preflight() -> Preflight:
    from inspect import signature

    row = Check(EVIL, EVIL, EVIL, Outcome.REFUSED, EVIL, EVIL)
    known = {
        "identity": Identity(1, 2, 3, 4, EVIL, False), "checks": (row,), "watchdog_s": 0.5, "safe_action": "quick_stop",
        "modes": frozenset(),
    }
    names = signature(Preflight).parameters
    rest = {name: 1.0 for name, one in names.items() if one.default is one.empty and name not in known}
    return Preflight(**{**rest, **known})      # type: ignore[arg-type]


def test_the_preflight_table_and_the_prompt():
    from types import SimpleNamespace

    found = preflight()
    table = shown(preflight_table(found))
    assert harmless(table)
    assert "[red]" in table
    limits = SimpleNamespace(probe_torque_nm=1.0, probe_travel_rad=1.0, speed_min_rad_s=0.5, speed_max_rad_s=10.0,
                             torque_nm=1.0, time_s=60.0)
    text = motion_summary(found, limits, ExcitationRequest(), (EVIL,))      # type: ignore[arg-type]
    assert harmless(text)
    assert "\nDrive: safe" not in text      # no additional line in the operator's prompt


def test_errors_of_the_tree():
    error = PreflightRefused(EVIL, where=EVIL, next_step=EVIL)
    assert harmless(str(error))


def test_a_profile_s_title(tmp_path, capsys):
    text = (ROOT / "profiles" / "generic" / "cia402.yaml").read_text(encoding="utf-8")
    line = next(line for line in text.splitlines() if line.startswith("title:"))
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace(line, 'title: "\\e[31mSafe\\e[2J [/] \\u202e"'), encoding="utf-8")
    assert main(["profiles", "show", str(path)]) == 0
    out = capsys.readouterr().out
    assert harmless(out)
    assert "␛[31mSafe␛[2J [/] ·" in out


def test_a_file_s_name(tmp_path, capsys):
    assert main(["replay", str(tmp_path / "a\x1b[2J.mcap")]) == 2
    err = capsys.readouterr().err
    assert harmless(err)
    assert "␛[2J" in err


def test_the_head_of_a_column(tmp_path, capsys):
    path = tmp_path / "trace.csv"
    path.write_text("time_s,\x1b[2Jspeed,torque_nm\n" + "".join(f"{n / 100},1,2\n" for n in range(300)), "utf-8")
    assert main(["replay", str(path)]) != 0
    assert harmless(capsys.readouterr().err)


@pytest.mark.parametrize("grade", ["ok", "bad"])
def test_a_line_of_doctor(grade):
    from tdhil.buses import DoctorFinding

    assert harmless(DoctorFinding(grade, "drive", EVIL, EVIL).text)
